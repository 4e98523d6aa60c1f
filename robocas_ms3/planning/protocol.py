"""The small interface between scripted policies and a motion planner.

Everything is in the arm's base frame, so the mobile base never matters to a backend. Poses are 4x4
float64 matrices in metres; ``tcp_in_base`` is ManiSkill's TCP (z approach, y closing). ``qpos`` are the 7 arm joints in
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
    """Joint positions (T, 7) in rad, ``dt`` seconds apart; row 0 is reached after ``dt``, the last row is the goal."""

    qpos: Array
    dt: float

    @property
    def duration(self) -> float:
        """Seconds from the start to the last row."""
        return len(self.qpos) * self.dt


@dataclass(frozen=True)
class AttachedBody:
    """An object in the gripper: the convex hull of vertices (V, 3) m in its frame, which is 4x4 in the TCP's."""

    vertices: Array
    object_in_tcp: Array


@dataclass(frozen=True, eq=False)
class Shape:
    """The form of a rigid body in its own frame: hulls or points. Backends keep what they make of it while it lives.

    Attributes:
        hulls: vertices (V, 3) of its convex pieces, m.
        points: (P, 3) samples at 5 mm of surfaces that no hulls describe, m.
    """

    hulls: tuple[Array, ...] = ()
    points: Array | None = None


@dataclass(frozen=True)
class Obstacle:
    """A rigid body that must not be touched, the pose of its frame (4x4), and how much room to keep to it, m."""

    name: str
    shape: Shape
    pose_in_base: Array
    clearance: float = 0.0


class Planner(Protocol):
    """What a backend offers. Every planning method raises ``PlanningError(stage, reason)``, never a sentinel.

    ``RRTConnectPlanner`` lists its reasons at each method.
    """

    @property
    def finger_width(self) -> float:
        """Distance between the pads in all collision checks, m."""
        ...

    @finger_width.setter
    def finger_width(self, width: float) -> None: ...

    def seed(self, seed: int) -> None:
        """Make everything that follows repeat exactly for the same calls."""
        ...

    def set_scene(self, obstacles: Sequence[Obstacle] | Array) -> None:
        """Replace the obstacles by rigid bodies, which costs little, or by a point cloud (P, 3) of surfaces at 5 mm.

        Points inside the robot's own base are cut out.
        """
        ...

    def attach(self, body: AttachedBody | None) -> None:
        """Attach a held object to the TCP, or nothing."""
        ...

    def tcp(self, qpos: Array) -> Array:
        """Return the TCP (4x4) in the arm's base frame at a configuration (7,)."""
        ...

    def collisions(self, qpos: Array, finger_width: float | None = None) -> list[str]:
        """Return what touches at a configuration (7,): links, obstacles ('cloud': of points), 'attached'; empty: free.

        ``finger_width`` is in m; default: of the open gripper.
        """
        ...

    def is_free(self, qpos: Array, finger_width: float | None = None) -> NDArray[np.bool_]:
        """Say which configurations (M, 7) touch nothing: (M,). Far cheaper than one at a time."""
        ...

    def ik(self, tcp_in_base: Array, near: Array, *, avoid_collisions: bool = True) -> list[Array]:
        """Return distinct configurations (7,) that reach a pose (4x4), nearest to ``near`` (7,) first, or none.

        With ``avoid_collisions`` only those free of collisions.
        """
        ...

    def plan_to_qpos(self, start: Array, goals: list[Array], *, stage: str, search: bool = True) -> Trajectory:
        """Plan a collision-free motion to the best of several configurations; without ``search`` a straight one."""
        ...

    def plan_to_pose(self, start: Array, tcp_in_base: Array, *, stage: str) -> Trajectory:
        """Plan a collision-free motion that ends with the TCP at a pose."""
        ...

    def plan_straight(
        self, start: Array, tcp_in_base: Array, *, stage: str, check_collisions: bool = True, speed: float = 1.0
    ) -> Trajectory:
        """Move the TCP on a straight line (and shortest rotation) from where ``start`` (7,) has it to a pose (4x4).

        Args:
            check_collisions: whether obstacles may not be touched (self-collisions always count).
            speed: fraction of the velocity and acceleration limits.
        """
        ...

    def join(self, start: Array, first: Trajectory, second: Trajectory) -> Trajectory:
        """Join two motions, the first from ``start`` (7,), without a stop where the scene allows it.

        The corner between them is cut within the last second of the first and the first second of the second.
        """
        ...
