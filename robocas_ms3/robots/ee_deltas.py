"""Motions of the end effector as actions: what `pd_ee_delta_pose` takes.

Its actions are (x, y, z, rx, ry, rz) in [-1, 1], all in the current TCP frame. Translation is metres / 0.1. Rotation is
Euler angles in radians / 0.5, in the convention of ManiSkill's controllers (intrinsic XYZ: R = Rx Ry Rz), its norm
clipped to 1. A positive angle turns positively about the TCP's axis (ManiSkill's own controller turns the other way).
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from robocas_ms3.core import rotations
from robocas_ms3.core.arrays import Array

POSITION_SCALE, ROTATION_SCALE = 0.1, 0.5  # m and rad at |action| = 1


def to_ee_delta_action(
    translation: np.ndarray, rotation: np.ndarray | Rotation, *, euler: str | None = None
) -> np.ndarray:
    """Turn a relative motion of the TCP, in its own frame, into the arm's part of a ``pd_ee_delta_pose`` action.

    Args:
        translation: (..., 3) m.
        rotation: (..., 3) rotation vectors, rad; or Euler angles with ``euler``; or a scipy ``Rotation``.
        euler: scipy's name of the convention when ``rotation`` holds Euler angles: ``"XYZ"`` intrinsic (ManiSkill's),
            ``"xyz"`` extrinsic (RoboCAS datasets read with scipy).

    Returns:
        (..., 6) float32, not clipped: beyond +-1 the motion does not fit into one step.
    """
    translation = np.asarray(translation, dtype=np.float64)
    if not isinstance(rotation, Rotation):
        angles = np.asarray(rotation, dtype=np.float64).reshape(-1, 3)
        rotation = Rotation.from_rotvec(angles) if euler is None else Rotation.from_euler(euler, angles)
    angles = rotation.as_euler("XYZ").reshape(translation.shape)
    return np.concatenate([translation / POSITION_SCALE, angles / ROTATION_SCALE], axis=-1).astype(np.float32)


def ee_delta_target(position: Array, quaternion: Array, delta: Array) -> tuple[Array, Array]:
    """Apply a motion given in the end effector's frame to its pose in any parent frame.

    Args:
        position: (N, 3) m, of the end effector in the parent frame.
        quaternion: (N, 4) wxyz.
        delta: (N, 6) translation in m and intrinsic XYZ Euler angles in rad, in the end effector's frame.

    Returns:
        Position (N, 3) and quaternion (N, 4) of the target in the parent frame.
    """
    rotation = rotations.from_euler(delta[:, 3:6])
    return position + rotations.rotate_float64(quaternion, delta[:, :3]), rotations.multiply(quaternion, rotation)
