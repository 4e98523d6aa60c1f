"""Interface between scripted policies and motion planners.

All poses are in the arm's base frame, so a backend is independent of the mobile base. Poses are 4x4 float64 matrices in
m; ``tcp_in_base`` is the pose of ManiSkill's TCP (z approach axis, y closing axis). ``qpos`` are the 7 arm joints in
rad.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Trajectory:
    """Joint positions (T, 7) in rad at times ``dt``, 2 ``dt``, ... in s; the last row is the goal."""

    qpos: Array
    dt: float

    @property
    def duration(self) -> float:
        """Time from the start to the last row, s."""
        return len(self.qpos) * self.dt


@dataclass(frozen=True)
class AttachedBody:
    """Object in the gripper: vertices (V, 3) of its convex hull, m, and its pose (4x4) in the TCP frame."""

    vertices: Array
    object_in_tcp: Array


@dataclass(frozen=True, eq=False)
class Shape:
    """Shape of a rigid body in its own frame: convex hulls or points. Backends cache geometries per shape.

    Attributes:
        hulls: vertices (V, 3) of the convex pieces, m.
        points: (P, 3) surface points 5 mm apart, m, for surfaces without hulls.
    """

    hulls: tuple[Array, ...] = ()
    points: Array | None = None


@dataclass(frozen=True)
class Obstacle:
    """Obstacle: name, shape, pose (4x4) of its frame, and clearance to keep, m."""

    name: str
    shape: Shape
    pose_in_base: Array
    clearance: float = 0.0


class Planner(Protocol):
    """Interface of a motion planner. Planning methods raise ``PlanningError(stage, reason)`` if they fail.

    ``RRTConnectPlanner`` documents its reasons at each method.
    """

    @property
    def finger_width(self) -> float:
        """Distance between the pads in all collision checks, m."""
        ...

    @finger_width.setter
    def finger_width(self, width: float) -> None: ...

    def seed(self, seed: int) -> None:
        """Set the seed; the same seed and calls give the same results."""
        ...

    def set_scene(self, obstacles: Sequence[Obstacle] | Array) -> None:
        """Replace the obstacles by rigid bodies (fast), or by a cloud (P, 3) of surface points 5 mm apart.

        Points inside the robot base are ignored.
        """
        ...

    def attach(self, body: AttachedBody | None) -> None:
        """Attach a held object to the TCP; None detaches it."""
        ...

    def tcp(self, qpos: Array) -> Array:
        """Return the TCP pose (4x4) in the arm's base frame at a configuration (7,)."""
        ...

    def find_collisions(self, qpos: Array, finger_width: float | None = None) -> list[str]:
        """Return the names of colliding bodies at a configuration (7,); an empty list means free.

        Names are links, obstacles, 'cloud' (points) and 'attached' (the held object). ``finger_width`` is in m;
        default: open gripper.
        """
        ...

    def is_free(self, qpos: Array, finger_width: float | None = None) -> NDArray[np.bool_]:
        """Return a mask (M,) of the collision-free configurations (M, 7); much faster than single checks."""
        ...

    def ik(self, tcp_in_base: Array, near: Array, *, avoid_collisions: bool = True) -> list[Array]:
        """Return distinct configurations (7,) for a TCP pose (4x4), the nearest to ``near`` (7,) first.

        With ``avoid_collisions``, only collision-free configurations. The list may be empty.
        """
        ...

    def plan_to_qpos(self, start: Array, goals: list[Array], *, stage: str, straight_only: bool = False) -> Trajectory:
        """Plan a collision-free motion to one of several configurations.

        Without ``search``, only straight motions in joint space are tried.
        """
        ...

    def plan_to_pose(self, start: Array, tcp_in_base: Array, *, stage: str) -> Trajectory:
        """Plan a collision-free motion of the TCP to a pose (4x4)."""
        ...

    def plan_straight(
        self, start: Array, tcp_in_base: Array, *, stage: str, check_collisions: bool = True, speed: float = 1.0
    ) -> Trajectory:
        """Plan a straight line of the TCP, with the shortest rotation, from ``start`` (7,) to a pose (4x4).

        Args:
            start: initial configuration.
            tcp_in_base: goal of the TCP.
            stage: stage of a ``PlanningError``.
            check_collisions: whether to check obstacles; self-collisions are always checked.
            speed: fraction of the velocity and acceleration limits.
        """
        ...

    def join(self, start: Array, first: Trajectory, second: Trajectory) -> Trajectory:
        """Join two motions, the first from ``start`` (7,), without a stop if that is collision-free.

        The blend starts in the last second of the first motion and ends in the first second of the second one.
        """
        ...
