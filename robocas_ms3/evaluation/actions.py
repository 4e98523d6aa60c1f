"""Action conventions of policies: motions of the TCP, or joint targets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Motion:
    """Relative motions of E TCPs, each in its own frame (z approach, y closing): (E, 3) m, E rotations, (E,) bool."""

    translation: Array
    rotation: Rotation
    open: NDArray[np.bool_]


@dataclass(frozen=True)
class Convention:
    """A convention of actions.

    Attributes:
        size: numbers per action.
        meaning: for people.
        read: converts actions (E, size) to motions; None: they are joint targets.
    """

    size: int
    meaning: str
    read: Callable[[Array], Motion] | None


def _robocas(actions: Array) -> Motion:
    return Motion(actions[:, :3], Rotation.from_euler("xyz", actions[:, 3:6]), actions[:, 6] > 0.5)


def _euler(actions: Array) -> Motion:
    return Motion(actions[:, :3], Rotation.from_euler("xyz", actions[:, 3:6]), actions[:, 6] > 0)


def _axis_angle(actions: Array) -> Motion:
    return Motion(actions[:, :3], Rotation.from_rotvec(actions[:, 3:6]), actions[:, 6] > 0)


def _quaternion(actions: Array) -> Motion:
    quaternions = actions[:, [4, 5, 6, 3]]
    lengths = np.linalg.norm(quaternions, axis=1, keepdims=True)
    identity = np.array([0.0, 0.0, 0.0, 1.0])
    quaternions = np.where(lengths > 1e-9, quaternions / np.maximum(lengths, 1e-9), identity)
    return Motion(actions[:, :3], Rotation.from_quat(quaternions), actions[:, 7] > 0)


CONVENTIONS: dict[str, Convention] = {
    "robocas": Convention(
        7, "m; Euler angles about fixed axes x, y, z, rad; gripper opening, above 0.5 is open: the paper's", _robocas
    ),
    "delta_euler": Convention(7, "m; Euler angles about fixed axes x, y, z, rad; gripper, above 0 is open", _euler),
    "delta_axis_angle": Convention(7, "m; rotation vector, rad; gripper, above 0 is open", _axis_angle),
    "delta_quaternion": Convention(8, "m; quaternion wxyz; gripper, above 0 is open", _quaternion),
    "joint_positions": Convention(8, "seven joint targets, rad; gripper, -1 closed to 1 open", None),
}
"""By name. Translation comes first, then rotation, both in the TCP's frame; the last number is the gripper's."""
