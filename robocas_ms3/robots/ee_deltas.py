"""Convert end-effector motions to and from actions of `pd_ee_delta_pose`.

Actions are (x, y, z, rx, ry, rz) in [-1, 1] in the current TCP frame. Translation is in metres / 0.1. Rotation is
intrinsic XYZ Euler angles in radians / 0.5, as in ManiSkill (R = Rx Ry Rz), with its norm clipped to 1. Actions of
RoboCAS datasets have Euler angles about fixed axes instead. A positive angle is a positive rotation about the TCP's
axis; in ManiSkill's own controller it is a negative rotation.
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
    """Convert a motion of the TCP to the first six values of a ``pd_ee_delta_pose`` action.

    Args:
        translation: (..., 3) m, in the present TCP frame.
        rotation: (..., 3) rotation vectors, rad, in the present TCP frame; or Euler angles, rad, with ``euler``; or a
            scipy ``Rotation``.
        euler: convention of the Euler angles in scipy's notation: ``"XYZ"`` intrinsic (ManiSkill), ``"xyz"`` about
            fixed axes (RoboCAS datasets).

    Returns:
        Actions (..., 6) float32, not clipped. A value beyond +-1 cannot be executed in one step.
    """
    translation = np.asarray(translation, dtype=np.float64)
    if not isinstance(rotation, Rotation):
        angles = np.asarray(rotation, dtype=np.float64).reshape(-1, 3)
        rotation = Rotation.from_rotvec(angles) if euler is None else Rotation.from_euler(euler, angles)
    angles = rotation.as_euler("XYZ").reshape(translation.shape)
    return np.concatenate([translation / POSITION_SCALE, angles / ROTATION_SCALE], axis=-1).astype(np.float32)


def apply_ee_delta(position: Array, quaternion: Array, delta: Array) -> tuple[Array, Array]:
    """Move poses of the end effector by motions in the end effector's frame.

    Args:
        position: (N, 3) position of the end effector in a parent frame, m.
        quaternion: (N, 4) orientation of the end effector in the parent frame, wxyz.
        delta: (N, 6) translation in m and intrinsic XYZ Euler angles in rad, in the end effector's frame.

    Returns:
        Position (N, 3) and quaternion wxyz (N, 4) of the moved end effector in the parent frame.
    """
    rotation = rotations.from_euler(delta[:, 3:6])
    return position + rotations.rotate_float64(quaternion, delta[:, :3]), rotations.multiply(quaternion, rotation)
