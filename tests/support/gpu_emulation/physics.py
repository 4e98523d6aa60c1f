"""Stand-in for ``sapien.physx.PhysxGpuSystem`` over one CPU system per env.

It keeps the properties of the GPU interface that batched code can get wrong:

- a buffer holds NaN until it is written or fetched, and what was fetched last until then;
- values written to a buffer reach the physics only by ``gpu_apply_*``; applying NaN is an error;
- link poses follow new joint positions and root poses only after ``gpu_update_articulation_kinematics`` or a step;
- rows of bodies and articulations are shuffled, so that they are not in the order of the envs;
- contact impulses are those of the last step.

Rows whose buffer equals the state of the physics are not written.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import sapien
from numpy.typing import NDArray
from sapien import physx

from gpu_emulation.buffers import BODY, FROM_PACKED, ArticulationColumns, Buffer, PackedSystem
from gpu_emulation.contacts import ContactQuery, Contacts

_POSE, _VELOCITY = slice(0, 7), slice(7, BODY)
_JOINT_BUFFERS = ("qpos", "qvel", "qf", "qacc", "target_qpos", "target_qvel")


class EmulatedGpuSystem:
    """Stand-in for ``PhysxGpuSystem``.

    Attributes:
        cuda_rigid_body_data: (B + A L, `BODY`), dynamic bodies, then the links of each articulation.
        cuda_articulation_qpos: (A, J); likewise ``qvel``, ``qf``, ``qacc``, ``target_qpos``, ``target_qvel``.
        ready: whether `gpu_init` was called.
    """

    cuda_articulation_qpos: Buffer
    cuda_articulation_qvel: Buffer
    cuda_articulation_qf: Buffer
    cuda_articulation_qacc: Buffer
    cuda_articulation_target_qpos: Buffer
    cuda_articulation_target_qvel: Buffer

    steps_on_init = True
    """Whether `gpu_init` steps once, as SAPIEN's does. A test may change it, to compare with recordings of a CPU."""

    def __init__(self, device: Any = None) -> None:
        self.device = device
        self.ready = False
        self._timestep = 0.01
        self._systems: list[physx.PhysxCpuSystem] = []
        self._offsets: dict[int, NDArray[np.float32]] = {}
        self._contacts = Contacts(self._systems)
        # link data before a change that `gpu_update_articulation_kinematics` has not seen yet
        self._links_before: NDArray[np.float32] | None = None

    def add_env(self) -> physx.PhysxCpuSystem:
        """Make the CPU system of one more env."""
        system = physx.PhysxCpuSystem()
        system.timestep = self._timestep
        self._systems.append(system)
        return system

    # ------------------------------------------------------------------ properties

    @property
    def timestep(self) -> float:
        return self._timestep

    @timestep.setter
    def timestep(self, value: float) -> None:
        self._timestep = value
        for system in self._systems:
            system.timestep = value

    def set_scene_offset(self, scene: Any, offset: Sequence[float]) -> None:
        self._offsets[id(scene)] = np.asarray(offset, np.float32)

    def get_scene_offset(self, scene: Any) -> NDArray[np.float32]:
        return self._offsets[id(scene)]

    @property
    def rigid_dynamic_components(self) -> list[Any]:
        return [body for system in self._systems for body in system.rigid_dynamic_components]

    @property
    def articulation_link_components(self) -> list[Any]:
        return [link for system in self._systems for link in system.articulation_link_components]

    # ------------------------------------------------------------------ start and step

    def gpu_init(self) -> None:
        """Allocate the buffers, and step once if `steps_on_init`."""
        if self.steps_on_init:
            for system in self._systems:
                system.step()
        shuffle = np.random.default_rng(len(self._systems)).permutation
        bodies = self.rigid_dynamic_components
        articulations = [link.articulation for link in self.articulation_link_components if link.is_root]
        self.body_rows = dict(zip(bodies, shuffle(len(bodies)).tolist(), strict=True))
        self.articulation_rows = dict(zip(articulations, shuffle(len(articulations)).tolist(), strict=True))
        links = max((len(articulation.links) for articulation in articulations), default=0)
        joints = max((articulation.dof for articulation in articulations), default=0)
        self.link_rows = {
            link: len(bodies) + row * links + link.index
            for articulation, row in self.articulation_rows.items()
            for link in articulation.links
        }
        data = np.full((len(bodies) + len(articulations) * links, BODY), np.nan, np.float32)
        self.cuda_rigid_body_data = Buffer(data)
        self._bodies, self._links = data[: len(bodies)], data[len(bodies) :].reshape(-1, links, BODY)
        for name in _JOINT_BUFFERS:
            values = np.full((len(articulations), joints), np.nan, np.float32)
            setattr(self, f"cuda_articulation_{name}", Buffer(values))
        self._envs = [PackedSystem(system, self.body_rows, self.articulation_rows) for system in self._systems]
        self.ready = True

    def step(self) -> None:
        if not self.ready:
            raise RuntimeError("failed to step: gpu simulation is not initialized.")
        for system in self._systems:
            system.step()
        self._changed()
        self._links_before = None
        self._contacts.clear()

    def gpu_update_articulation_kinematics(self) -> None:
        self._links_before = None

    def sync_poses_gpu_to_cpu(self) -> None:
        """Do nothing: the poses are on the CPU."""

    # ------------------------------------------------------------------ fetch

    def gpu_fetch_rigid_dynamic_data(self) -> None:
        for env in self._envs:
            self._bodies[env.rows] = env.read_bodies()

    def gpu_fetch_articulation_link_pose(self) -> None:
        self._fetch_links(_POSE)

    def gpu_fetch_articulation_link_velocity(self) -> None:
        self._fetch_links(_VELOCITY)

    def gpu_fetch_articulation_qpos(self) -> None:
        self._fetch_joints("qpos")

    def gpu_fetch_articulation_qvel(self) -> None:
        self._fetch_joints("qvel")

    def gpu_fetch_articulation_target_qpos(self) -> None:
        self._fetch_joints("target_qpos")

    def gpu_fetch_articulation_target_qvel(self) -> None:
        self._fetch_joints("target_qvel")

    def gpu_fetch_articulation_qacc(self) -> None:
        values = self.cuda_articulation_qacc.array
        for articulation, row in self.articulation_rows.items():
            values[row, : articulation.dof], values[row, articulation.dof :] = articulation.qacc, 0

    def _fetch_links(self, columns: slice) -> None:
        links = self._read_links() if self._links_before is None else self._links_before
        self._links[..., columns] = links[..., columns]

    def _read_links(self) -> NDArray[np.float32]:
        data = np.full_like(self._links, np.nan)
        for articulation, row in self.articulation_rows.items():
            for link in articulation.links:
                pose = link.entity_pose
                data[row, link.index] = [*pose.p, *pose.q, *link.linear_velocity, *link.angular_velocity]
        return data

    def _fetch_joints(self, name: str) -> None:
        values = getattr(self, f"cuda_articulation_{name}").array
        for env in self._envs:
            packed = env.read()
            for columns in env.articulations:
                dof = columns.articulation.dof
                values[columns.row, :dof], values[columns.row, dof:] = packed[getattr(columns, name)], 0

    # ------------------------------------------------------------------ apply

    def gpu_apply_rigid_dynamic_data(self) -> None:
        for env in self._envs:
            present, wanted = env.read_bodies(), self._bodies[env.rows]
            _check_finite(wanted, "states of bodies")
            for i in np.flatnonzero((present != wanted).any(axis=1)).tolist():
                body, row = env.bodies[i], wanted[i]
                if (present[i, _POSE] != row[_POSE]).any():
                    body.entity.pose = sapien.Pose(row[:3], row[3:7])
                if not body.kinematic:
                    body.linear_velocity, body.angular_velocity = row[7:10], row[10:]
        self._changed()

    def gpu_apply_articulation_qpos(self) -> None:
        for columns, wanted in self._differing_joints("qpos"):
            self._keep_links()
            columns.articulation.qpos = wanted
        self._changed()

    def gpu_apply_articulation_qvel(self) -> None:
        for columns, wanted in self._differing_joints("qvel"):
            columns.articulation.qvel = wanted
        self._changed()

    def gpu_apply_articulation_qf(self) -> None:
        values = self.cuda_articulation_qf.array
        _check_finite(values, "joint forces")
        for articulation, row in self.articulation_rows.items():
            if values[row].any():
                articulation.qf = values[row, : articulation.dof]

    def gpu_apply_articulation_target_position(self) -> None:
        for columns, wanted in self._differing_joints("target_qpos"):
            for joint, target in zip(columns.articulation.active_joints, wanted.tolist(), strict=True):
                joint.set_drive_target(target)
        self._changed()

    def gpu_apply_articulation_target_velocity(self) -> None:
        for columns, wanted in self._differing_joints("target_qvel"):
            for joint, target in zip(columns.articulation.active_joints, wanted.tolist(), strict=True):
                joint.set_drive_velocity_target(target)
        self._changed()

    def gpu_apply_articulation_root_pose(self) -> None:
        for columns, wanted in self._differing_roots(_POSE):
            self._keep_links()
            assert self._links_before is not None
            columns.articulation.root_pose = sapien.Pose(wanted[:3], wanted[3:])
            self._links_before[columns.row, 0, _POSE] = wanted
        self._changed()

    def gpu_apply_articulation_root_velocity(self) -> None:
        for columns, wanted in self._differing_roots(_VELOCITY):
            columns.articulation.root_linear_velocity = wanted[:3]
            columns.articulation.root_angular_velocity = wanted[3:]
        self._changed()

    def _differing_joints(self, name: str) -> list[tuple[ArticulationColumns, NDArray[np.float32]]]:
        """Articulations whose buffer (J,) differs from the physics."""
        values, differing = getattr(self, f"cuda_articulation_{name}").array, []
        for columns, packed in self._articulations():
            wanted = values[columns.row, : columns.articulation.dof]
            _check_finite(wanted, name)
            if (packed[getattr(columns, name)] != wanted).any():
                differing.append((columns, wanted))
        return differing

    def _differing_roots(self, part: slice) -> list[tuple[ArticulationColumns, NDArray[np.float32]]]:
        """Articulations whose root differs from the physics in some columns of `BODY`."""
        differing = []
        for columns, packed in self._articulations():
            wanted = self._links[columns.row, 0, part]
            _check_finite(wanted, "states of roots")
            if (packed[columns.root][FROM_PACKED][part] != wanted).any():
                differing.append((columns, wanted))
        return differing

    def _articulations(self) -> Iterator[tuple[ArticulationColumns, NDArray[np.float32]]]:
        for env in self._envs:
            packed = env.read()
            for columns in env.articulations:
                yield columns, packed

    def _keep_links(self) -> None:
        if self._links_before is None:
            self._links_before = self._read_links()

    def _changed(self) -> None:
        for env in self._envs:
            env.changed()

    # ------------------------------------------------------------------ contacts

    def gpu_create_contact_pair_impulse_query(self, pairs: Sequence[tuple[Any, Any]]) -> ContactQuery:
        return self._contacts.pair_query(pairs)

    def gpu_query_contact_pair_impulses(self, query: ContactQuery) -> None:
        self._contacts.read(query)


def _check_finite(values: NDArray[np.float32], name: str) -> None:
    if not np.isfinite(values).all():
        raise RuntimeError(f"NaN or infinity is applied to {name}: it was neither written nor fetched")
