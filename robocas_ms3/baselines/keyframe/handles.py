"""Handles of doors and drawers, and how they are pulled."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.poses import Array, from_rotation, from_wxyz
from robocas_ms3.demos.candidates.tables import Arrays

_BAR_RADIUS, _BAR_HALF_LENGTH = 0.025, 0.08  # m from the axis of the bar, and along it from the grasp
_MIN_PULL = 0.08  # m, length of a motion below which a door or drawer is open
_MIN_NORM, _MAX_COSINE = 0.8, 0.3  # of approach and bar, which cells predict independently of each other
_MAX_SLOPE = 0.3  # vertical part of the motion of a door or drawer


@dataclass(frozen=True)
class Handle:
    """Handle of a door or drawer, in the arm's base frame.

    Attributes:
        position: (3,) TCP position of the grasp, m.
        motion: (3,) straight motion of the TCP that opens the door or drawer, m; zero if it is open.
        approach: (3,) approach direction of the gripper, a unit vector.
        bar: (3,) axis of the bar, a unit vector.
    """

    position: Array
    motion: Array
    approach: Array
    bar: Array

    @property
    def grasp(self) -> Array:
        """TCP pose (4, 4) of the grasp: x along the bar, z along the approach."""
        z = self.approach / np.linalg.norm(self.approach)
        x = self.bar - z * (z @ self.bar)
        x /= np.linalg.norm(x)
        return from_rotation(self.position, np.stack([x, np.cross(z, x), z], axis=1))

    @property
    def can_be_pulled(self) -> bool:
        """Whether a predicted handle has a motion that may open a door or drawer.

        The motion is horizontal, at least 8 cm long, and does not point into the furniture. Approach and bar are
        perpendicular, and nearly unit vectors: medians over cells that contradict each other are shorter. Hinged doors
        are not told apart.
        """
        length = np.linalg.norm(self.motion)
        norms = np.array([np.linalg.norm(self.approach), np.linalg.norm(self.bar)])
        return bool(
            length > _MIN_PULL
            and abs(self.motion[2]) <= _MAX_SLOPE * length
            and self.motion @ self.approach <= _MAX_COSINE * length * norms[0]
            and norms.min() >= _MIN_NORM
            and abs(self.approach @ self.bar) <= _MAX_COSINE * norms.prod()
        )

    def contains(self, points: Array) -> NDArray[np.bool_]:
        """Return which points (..., 3) are on the bar near the grasp, up to 2.5 cm from its axis."""
        offsets = points - self.position
        along = offsets @ self.bar
        away = np.linalg.norm(offsets - along[..., None] * self.bar, axis=-1)
        return (away < _BAR_RADIUS) & (np.abs(along) < _BAR_HALF_LENGTH)

    def move_to_end(self) -> Handle:
        """Return the handle after the motion."""
        return replace(self, position=self.position + self.motion, motion=np.zeros(3))


def find_pulled_handle(candidates: Arrays) -> Handle | None:
    """Return the handle that successful pulls of a decision grasp, the mean of them, or None."""
    pulls = (candidates["primitive"] == "pull") & candidates["success"]
    pulls &= np.isfinite(candidates["final_in_base"]).all(axis=1)
    if not pulls.any():
        return None
    start = from_wxyz(candidates["start_in_base"][pulls].astype(np.float64))
    final = from_wxyz(candidates["final_in_base"][pulls].astype(np.float64))
    bars = start[:, :3, 0]
    bars = bars * np.where((bars @ (0.1, 0.3, 1.0)) < 0, -1.0, 1.0)[:, None]  # mostly upwards, or to the left
    directions = [vectors.mean(axis=0) for vectors in (start[:, :3, 2], bars)]
    approach, bar = (direction / np.linalg.norm(direction) for direction in directions)
    position, end = start[:, :3, 3].mean(axis=0), final[:, :3, 3].mean(axis=0)
    return Handle(position, end - position, approach, bar)
