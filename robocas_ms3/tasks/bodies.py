"""Poses and velocities of all bodies, and contact forces, read from a scene at once, not actor by actor."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np
import torch
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.structs import Actor, Articulation, Link
from numpy.typing import NDArray

from robocas_ms3.core.arrays import Array, as_tensor
from robocas_ms3.core.errors import RobocasError

BODY = 13
"""Numbers of a body: position m, quaternion wxyz, linear velocity m/s, angular velocity rad/s, all in the world."""
_PACKED_BODY = [4, 5, 6, 0, 1, 2, 3, *range(7, BODY)]  # a body as SAPIEN packs it: the quaternion comes first
_PACKED_PER_JOINT = 4  # the positions of all joints, then their velocities, and what is not read here

# m between bodies that can't have touched in the last physics step, at whose beginning contacts are found: more than
# they go in 10 ms, at 4 m/s, and where PhysX begins to look for contacts
_NEAR = 0.05

_Boxes = tuple[NDArray[np.float32], NDArray[np.float32]]
_Batch = TypeVar("_Batch", torch.Tensor, NDArray[np.float32])


class Bodies:
    """Reads the state of all bodies of a scene, in the layout of ManiSkill's flat states.

    First come the A actors that can move, ``BODY`` numbers each, then of each articulation its root, qpos and qvel.

    On a CPU that is one call of SAPIEN's, and its result is kept while the scene's bytes stay the same, so it is
    never out of date. On a GPU it is gathered from the buffers each time.

    Args:
        scene: ready to be simulated.
        robot: what `others` leaves out.
        objects: the actors that `objects` reads, built one after the other.
        basket: the actor that `basket` reads, if there is one.

    Raises:
        RobocasError: this version of SAPIEN packs states otherwise.
    """

    def __init__(
        self, scene: ManiSkillScene, robot: Articulation, objects: Sequence[Actor] = (), basket: Actor | None = None
    ) -> None:
        self._scene = scene
        self._px: Any = scene.px
        registry = scene.state_dict_registry
        self._actors = [actor for actor in registry.actors.values() if actor.px_body_type != "static"]
        self._articulations = list(registry.articulations.values())
        self.actors = [actor.name for actor in self._actors]
        rows = [self.actors.index(actor.name) for actor in objects]
        first = rows[0] if rows else 0
        assert rows == list(range(first, first + len(rows))), "the objects are built one after the other"
        self._objects = slice(first, first + len(rows))
        self._basket = None if basket is None else self.actors.index(basket.name)
        sizes = [BODY + 2 * articulation.max_dof for articulation in self._articulations]
        ends = len(self._actors) * BODY + np.cumsum(sizes)
        self._columns: dict[str, dict[str, slice]] = {
            "actors": {name: slice(i * BODY, (i + 1) * BODY) for i, name in enumerate(self.actors)},
            "articulations": {
                articulation.name: slice(end - size, end)
                for articulation, size, end in zip(self._articulations, sizes, ends.tolist(), strict=True)
            },
        }
        if scene.gpu_sim_enabled:
            roots = [articulation.root for articulation in self._articulations]
            self._rows = torch.stack([body._body_data_index for body in [*self._actors, *roots]], dim=1)
        else:
            self._order, self._robot = self._packed_order(robot)
            self._packed: bytes = b""
            self._state = torch.empty(0)

    def read(self) -> torch.Tensor:
        """(N, D) float32: the state of each env. It stays as it is while the world moves on; don't write to it."""
        if self._scene.gpu_sim_enabled:
            return self._gather()
        packed = self._px.pack()
        if packed != self._packed:
            self._packed = packed
            self._state = torch.from_numpy(np.frombuffer(packed, np.float32)[self._order])[None]
        return self._state

    @property
    def state_except_robot(self) -> tuple[bytes, bytes] | None:
        """All but the robot at the last `read`, to be compared: the same means that nothing moved; None on a GPU."""
        if self._scene.gpu_sim_enabled:
            return None
        return self._packed[: self._robot.start], self._packed[self._robot.stop :]

    def actor_states(self, state: torch.Tensor) -> torch.Tensor:
        """(N, A, 13) the actors' part of a state (N, D), in the order of ``actors``."""
        count = len(self._actors)
        return state[:, : count * BODY].view(-1, count, BODY)

    def objects(self, state: torch.Tensor) -> torch.Tensor:
        """(N, K, 13) the objects' part of a state (N, D); a view."""
        return self.actor_states(state)[:, self._objects]

    def basket(self, state: torch.Tensor) -> torch.Tensor | None:
        """(N, 7) the basket's pose in a state (N, D), a view; None where there is no basket."""
        return None if self._basket is None else self.actor_states(state)[:, self._basket, :7]

    def split(self, states: _Batch) -> dict[str, dict[str, _Batch]]:
        """Name the parts of states (..., D), as ManiSkill does: ``{"actors": {name: (..., 13)}, ...}``; all views."""
        return {
            kind: {name: states[..., columns] for name, columns in found.items()}
            for kind, found in self._columns.items()
        }

    def _packed_order(self, robot: Articulation) -> tuple[NDArray[np.int64], slice]:
        """Which of SAPIEN's packed numbers each number of a state is, and which of its bytes are the robot's."""
        dynamic: list[Any] = self._px.rigid_dynamic_components
        first = {body: i * BODY for i, body in enumerate(dynamic)}
        order = [first[actor._bodies[0]] + k for actor in self._actors for k in _PACKED_BODY]
        start, starts = len(dynamic) * BODY, {}
        for link in self._px.articulation_link_components:
            if link.is_root:
                starts[link.articulation] = start
                start += BODY + _PACKED_PER_JOINT * link.articulation.dof
        found = len(self._px.pack())
        if found != 4 * start:
            fix = "Install the version of sapien that requirements.lock names."
            raise RobocasError("SAPIEN packs states otherwise", expected=f"{4 * start} bytes", found=found, fix=fix)
        for articulation in self._articulations:
            start = starts[articulation._objs[0]]
            order += [start + k for k in (*_PACKED_BODY, *range(BODY, BODY + 2 * articulation.max_dof))]
        start = starts[robot._objs[0]]
        return np.array(order), slice(4 * start, 4 * (start + BODY + _PACKED_PER_JOINT * robot.max_dof))

    def set_object_poses(self, envs: torch.Tensor, poses: torch.Tensor) -> None:
        """Put the objects of some envs somewhere at once, on a GPU; `ManiSkillScene._gpu_apply_all` tells PhysX.

        Args:
            envs: (E,) indices.
            poses: (E, K, 7) in the world.
        """
        if self._scene.parallel_in_single_scene:
            poses = poses.clone()
            poses[..., :3] += self._scene.scene_offsets[envs, None]
        self._px.cuda_rigid_body_data.torch()[self._rows[envs, self._objects], :7] = poses

    def stop(self, envs: torch.Tensor) -> None:
        """Take all velocities from some envs (E,) at once, on a GPU; see `set_object_poses`."""
        self._px.cuda_rigid_body_data.torch()[self._rows[envs].flatten(), 7:BODY] = 0.0
        for articulation in self._articulations:
            self._px.cuda_articulation_qvel.torch()[articulation._data_index[envs], : articulation.max_dof] = 0.0

    def _gather(self) -> torch.Tensor:
        bodies = self._px.cuda_rigid_body_data.torch()[self._rows, :BODY]
        if self._scene.parallel_in_single_scene:
            bodies[..., :3] -= self._scene.scene_offsets[:, None]
        parts = [bodies[:, : len(self._actors)].flatten(1)]
        for i, articulation in enumerate(self._articulations, start=len(self._actors)):
            parts += [bodies[:, i], articulation.qpos, articulation.qvel]
        return torch.cat(parts, dim=1)


def link_poses(scene: ManiSkillScene, links: Sequence[Link]) -> Array:
    """Return the poses (N, L, 7) of links in the world: position m, quaternion wxyz; native (`arrays`)."""
    if scene.gpu_sim_enabled:
        return torch.stack([link.pose.raw_pose for link in links], dim=1)
    poses = [link._bodies[0].entity_pose for link in links]
    return np.array([[[*pose.p, *pose.q] for pose in poses]], np.float32)


class Contacts:
    """Reads the forces between a few bodies and many objects, all pairs at once.

    ManiSkill asks for one pair at a time and, on a CPU, walks over all contacts again for each.

    Args:
        scene: ready to be simulated.
        bodies: B of them.
        objects: K of them.
    """

    def __init__(self, scene: ManiSkillScene, bodies: Sequence[Actor | Link], objects: Sequence[Actor | Link]) -> None:
        self._scene = scene
        self._px: Any = scene.px
        self._shape = (len(bodies), len(objects))
        if scene.gpu_sim_enabled:
            pairs = [
                pair for b in bodies for o in objects for pair in zip(b._bodies, o._bodies, strict=True)
            ]  # one an env
            self._query = self._px.gpu_create_contact_pair_impulse_query(pairs)
        else:
            self._bodies = [body._bodies[0] for body in bodies]
            self._objects = [body._bodies[0] for body in objects]
            self._none = np.zeros((1, *self._shape, 3), np.float32)
            self._boxes: tuple[object, _Boxes] | None = None
            self._rows: dict[Any, int] = {body: i for i, body in enumerate(self._bodies)}
            self._columns: dict[Any, int] = {body: i for i, body in enumerate(self._objects)}

    def forces(self, still: object = None) -> Array:
        """Force that each object exerts on each body, summed over their contact points, in the last physics step.

        Args:
            still: what is the same as at the last call only if the objects have not moved since; None: not known.

        Returns:
            (N, B, K, 3) N, world frame, native (`arrays`); don't write to it.
        """
        if self._scene.gpu_sim_enabled:
            self._px.gpu_query_contact_pair_impulses(self._query)
            impulses = self._query.cuda_impulses.torch().view(*self._shape, -1, 3).permute(2, 0, 1, 3)
            return impulses / self._px.timestep
        if self._apart(still):
            return self._none
        impulses, rows, columns = np.zeros((1, *self._shape, 3), np.float32), self._rows, self._columns
        for contact in self._px.get_contacts():
            first, second = contact.bodies
            if first in rows and second in columns:
                total, sign = impulses[0, rows[first], columns[second]], 1
            elif second in rows and first in columns:
                total, sign = impulses[0, rows[second], columns[first]], -1  # an impulse acts on the first body
            else:
                continue
            for point in contact.points:
                total += sign * point.impulse
        return impulses / np.float32(self._px.timestep)

    def _apart(self, still: object) -> bool:
        """Whether no object is near any body, on a CPU: then there is no need to look through a heap's contacts."""
        if self._boxes is None or still is None or self._boxes[0] != still:
            self._boxes = still, _bounds(self._objects)
        low, high = _bounds(self._bodies)
        others_low, others_high = self._boxes[1]
        gaps = np.maximum(low[:, None] - others_high, others_low - high[:, None])  # (B, K, 3), along each axis
        return bool((gaps.max(-1) > _NEAR).all())


def _bounds(bodies: list[Any]) -> _Boxes:
    """Least and greatest corners (B, 3) of boxes around bodies, world."""
    boxes = np.array([body.get_global_aabb_fast() for body in bodies])
    return boxes[:, 0], boxes[:, 1]


def contact_forces(
    scene: ManiSkillScene, bodies: Sequence[Actor | Link], objects: Sequence[Actor | Link]
) -> torch.Tensor:
    """`Contacts.forces` of bodies that are asked for once."""
    return as_tensor(Contacts(scene, bodies, objects).forces())
