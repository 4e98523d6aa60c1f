"""Read the states of all bodies, and the contact forces between bodies, from a scene in one call."""

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
"""Length of a body's state: position m, quaternion wxyz, linear velocity m/s, angular velocity rad/s, world frame."""
_PACKED_BODY = [4, 5, 6, 0, 1, 2, 3, *range(7, BODY)]  # SAPIEN packs the quaternion before the position
_PACKED_PER_JOINT = 4  # positions of all joints, then velocities, then values that are not read here

# Bodies with a greater distance, in m, can't have touched in the last physics step of 10 ms: the value is greater than
# the motion at 4 m/s plus the distance at which PhysX creates contacts.
_CONTACT_DISTANCE = 0.05

_Boxes = tuple[NDArray[np.float32], NDArray[np.float32]]
_Batch = TypeVar("_Batch", torch.Tensor, NDArray[np.float32])


class BodyStateReader:
    """Reader of the states of all bodies of a scene, in the format of ManiSkill's flat states.

    The flat state (N, D) of N envs has ``BODY`` numbers for each of the A movable actors, then root state (``BODY``
    numbers), qpos and qvel of each articulation.

    On a CPU, one call of SAPIEN returns the packed state of all bodies. The converted state is reused until the packed
    bytes change. On a GPU, each call gathers the state from the buffers of PhysX.

    Args:
        scene: a scene that is ready to be simulated.
        robot: the articulation that `state_except_robot` omits.
        objects: the actors whose states `object_states` returns; they were built one after the other.
        basket: the actor whose pose `basket_pose` returns; None if the scene has no basket.

    Attributes:
        actors: names of the A movable actors, in the order of the flat state.

    Raises:
        RobocasError: the installed version of SAPIEN packs states differently.
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
        """Return the states (N, D) float32 of all envs; read only, not changed by later steps."""
        if self._scene.gpu_sim_enabled:
            return self._gather_on_gpu()
        packed = self._px.pack()
        if packed != self._packed:
            self._packed = packed
            self._state = torch.from_numpy(np.frombuffer(packed, np.float32)[self._order])[None]
        return self._state

    @property
    def state_except_robot(self) -> tuple[bytes, bytes] | None:
        """Packed state of all bodies except the robot at the last `read`, to detect motion; None on a GPU."""
        if self._scene.gpu_sim_enabled:
            return None
        return self._packed[: self._robot.start], self._packed[self._robot.stop :]

    def actor_states(self, state: torch.Tensor) -> torch.Tensor:
        """Return the actor states (N, A, 13) in a flat state (N, D), in the order of ``actors``; a view."""
        count = len(self._actors)
        return state[:, : count * BODY].view(-1, count, BODY)

    def object_states(self, state: torch.Tensor) -> torch.Tensor:
        """Return the object states (N, K, 13) in a flat state (N, D); a view."""
        return self.actor_states(state)[:, self._objects]

    def basket_pose(self, state: torch.Tensor) -> torch.Tensor | None:
        """Return the basket pose (N, 7) in a flat state (N, D), a view; None if the scene has no basket."""
        return None if self._basket is None else self.actor_states(state)[:, self._basket, :7]

    def to_state_dict(self, states: _Batch) -> dict[str, dict[str, _Batch]]:
        """Convert flat states (..., D) to ManiSkill's nested dictionary of views.

        Example: ``{"actors": {name: (..., 13)}, "articulations": {...}}``.
        """
        return {
            kind: {name: states[..., columns] for name, columns in found.items()}
            for kind, found in self._columns.items()
        }

    def _packed_order(self, robot: Articulation) -> tuple[NDArray[np.int64], slice]:
        """Return where the packed state has each number of a flat state, and the bytes of the robot.

        The first value is an index (D,), the second value a slice.
        """
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
            what = "unexpected size of SAPIEN's packed state"
            raise RobocasError(what, expected=f"{4 * start} bytes", found=f"{found} bytes", fix=fix)
        for articulation in self._articulations:
            start = starts[articulation._objs[0]]
            order += [start + k for k in (*_PACKED_BODY, *range(BODY, BODY + 2 * articulation.max_dof))]
        start = starts[robot._objs[0]]
        return np.array(order), slice(4 * start, 4 * (start + BODY + _PACKED_PER_JOINT * robot.max_dof))

    def set_object_poses(self, envs: torch.Tensor, poses: torch.Tensor) -> None:
        """Write object poses of some envs to the buffers of a GPU.

        `ManiSkillScene._gpu_apply_all` applies them.

        Args:
            envs: (E,) indices of the envs.
            poses: (E, K, 7) in the world frame: position m, quaternion wxyz.
        """
        if self._scene.parallel_in_single_scene:
            poses = poses.clone()
            poses[..., :3] += self._scene.scene_offsets[envs, None]
        self._px.cuda_rigid_body_data.torch()[self._rows[envs, self._objects], :7] = poses

    def zero_velocities(self, envs: torch.Tensor) -> None:
        """Write zero velocities of all bodies of some envs (E,) to the buffers of a GPU."""
        self._px.cuda_rigid_body_data.torch()[self._rows[envs].flatten(), 7:BODY] = 0.0
        for articulation in self._articulations:
            self._px.cuda_articulation_qvel.torch()[articulation._data_index[envs], : articulation.max_dof] = 0.0

    def _gather_on_gpu(self) -> torch.Tensor:
        bodies = self._px.cuda_rigid_body_data.torch()[self._rows, :BODY]
        if self._scene.parallel_in_single_scene:
            bodies[..., :3] -= self._scene.scene_offsets[:, None]
        parts = [bodies[:, : len(self._actors)].flatten(1)]
        for i, articulation in enumerate(self._articulations, start=len(self._actors)):
            parts += [bodies[:, i], articulation.qpos, articulation.qvel]
        return torch.cat(parts, dim=1)


def read_link_poses(scene: ManiSkillScene, links: Sequence[Link]) -> Array:
    """Return the world poses (N, L, 7) of L links as a native array (`core.arrays`).

    A pose is a position in m and a quaternion wxyz.
    """
    if scene.gpu_sim_enabled:
        return torch.stack([link.pose.raw_pose for link in links], dim=1)
    poses = [link._bodies[0].entity_pose for link in links]
    return np.array([[[*pose.p, *pose.q] for pose in poses]], np.float32)


class ContactForceReader:
    """Reader of the contact forces between bodies and objects, for all pairs in one pass.

    ManiSkill reads one pair at a time and, on a CPU, iterates over all contacts of the scene for each pair.

    Args:
        scene: a scene that is ready to be simulated.
        bodies: B bodies, such as the links of the gripper.
        objects: K objects.
    """

    def __init__(self, scene: ManiSkillScene, bodies: Sequence[Actor | Link], objects: Sequence[Actor | Link]) -> None:
        self._scene = scene
        self._px: Any = scene.px
        self._shape = (len(bodies), len(objects))
        if scene.gpu_sim_enabled:
            pairs = [
                pair for b in bodies for o in objects for pair in zip(b._bodies, o._bodies, strict=True)
            ]  # one pair per env
            self._query = self._px.gpu_create_contact_pair_impulse_query(pairs)
        else:
            self._bodies = [body._bodies[0] for body in bodies]
            self._objects = [body._bodies[0] for body in objects]
            self._none = np.zeros((1, *self._shape, 3), np.float32)
            self._boxes: tuple[object, _Boxes] | None = None
            self._rows: dict[Any, int] = {body: i for i, body in enumerate(self._bodies)}
            self._columns: dict[Any, int] = {body: i for i, body in enumerate(self._objects)}

    def read_forces(self, object_state: object = None) -> Array:
        """Return the force of each object on each body in the last physics step, summed over contact points.

        Args:
            object_state: a value that differs after an object has moved, such as `BodyStateReader.state_except_robot`.
                While it stays equal, bounding boxes of the objects are reused. None: read them again.

        Returns:
            (N, B, K, 3) in newtons, world frame; a native array (`core.arrays`), read only.
        """
        if self._scene.gpu_sim_enabled:
            self._px.gpu_query_contact_pair_impulses(self._query)
            impulses = self._query.cuda_impulses.torch().view(*self._shape, -1, 3).permute(2, 0, 1, 3)
            return impulses / self._px.timestep
        if self._no_object_near(object_state):
            return self._none
        # summed as float64, because the order of the contacts is not fixed, and with it the rounding of float32 sums
        impulses, rows, columns = np.zeros((1, *self._shape, 3)), self._rows, self._columns
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
        return (impulses / self._px.timestep).astype(np.float32)

    def _no_object_near(self, object_state: object) -> bool:
        """Return whether every object is too far from every body for a contact; only on a CPU."""
        if self._boxes is None or object_state is None or self._boxes[0] != object_state:
            self._boxes = object_state, _bounding_boxes(self._objects)
        low, high = _bounding_boxes(self._bodies)
        others_low, others_high = self._boxes[1]
        gaps = np.maximum(low[:, None] - others_high, others_low - high[:, None])  # (B, K, 3), along each axis
        return bool((gaps.max(-1) > _CONTACT_DISTANCE).all())


def _bounding_boxes(bodies: list[Any]) -> _Boxes:
    """Return lower and upper corners (B, 3) of the bounding boxes of B bodies, world frame, m."""
    boxes = np.array([body.get_global_aabb_fast() for body in bodies])
    return boxes[:, 0], boxes[:, 1]


def read_contact_forces(
    scene: ManiSkillScene, bodies: Sequence[Actor | Link], objects: Sequence[Actor | Link]
) -> torch.Tensor:
    """Return the force (N, B, K, 3) of each object on each body in the last physics step.

    Newtons, world frame.
    """
    return as_tensor(ContactForceReader(scene, bodies, objects).read_forces())
