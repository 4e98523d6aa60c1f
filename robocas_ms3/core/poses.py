"""Rigid transforms in NumPy, float64: 4x4 matrices, and 7-D poses (position, quaternion) of files and simulators.

``T_a_b`` maps points of frame b into frame a. Quaternions are wxyz, except in RoboCAS datasets and SciPy, which use
xyzw. `core.rotations` has operations on batches of environments.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]


def inverse(poses: Array) -> Array:
    """Invert rigid transforms (..., 4, 4)."""
    result = np.zeros_like(poses)
    rotation = np.swapaxes(poses[..., :3, :3], -1, -2)
    result[..., :3, :3] = rotation
    result[..., :3, 3] = -(rotation @ poses[..., :3, 3, None])[..., 0]
    result[..., 3, 3] = 1
    return result


def from_wxyz(poses: Any) -> Array:
    """Convert poses (..., 7) (position, quaternion wxyz; array or CPU tensor) to transforms (..., 4, 4)."""
    if poses.ndim == 1:
        return _single_from_wxyz(*poses.tolist())
    poses = np.asarray(poses, np.float64)
    return from_xyzw(poses[..., :3], wxyz_to_xyzw(poses[..., 3:]))


def to_wxyz(poses: Array) -> Array:
    """Convert transforms (..., 4, 4) to poses (..., 7): position, quaternion wxyz of either sign."""
    xyzw = Rotation.from_matrix(poses[..., :3, :3].reshape(-1, 3, 3)).as_quat().reshape(*poses.shape[:-2], 4)
    return np.concatenate([poses[..., :3, 3], xyzw_to_wxyz(xyzw)], axis=-1)


def from_xyzw(positions: Array, xyzw: Array) -> Array:
    """Return transforms (..., 4, 4) from positions (..., 3) and quaternions xyzw (..., 4)."""
    rotation = Rotation.from_quat(xyzw.reshape(-1, 4)).as_matrix()
    return from_rotation(positions, rotation.reshape(*xyzw.shape[:-1], 3, 3))


def from_rotation(positions: Any, rotations: Any) -> Array:
    """Return transforms (..., 4, 4) from positions (..., 3) and rotation matrices (..., 3, 3)."""
    positions = np.asarray(positions, np.float64)
    result = np.zeros((*positions.shape[:-1], 4, 4))
    result[..., :3, :3], result[..., :3, 3], result[..., 3, 3] = rotations, positions, 1
    return result


def from_xyz_yaw(x: float, y: float, z: float, yaw: float) -> Array:
    """Return the transform (4, 4) with position x, y, z in m and rotation ``yaw`` in rad about the z axis."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.array([[cos, -sin, 0, x], [sin, cos, 0, y], [0, 0, 1, z], [0, 0, 0, 1.0]])


def transform_points(pose: Array, points: Array) -> Array:
    """Transform points (..., P, 3) by one transform (4, 4), or by one transform per batch element (..., 4, 4)."""
    offset = pose[..., None, :3, 3] if pose.ndim > 2 else pose[:3, 3]
    return points @ pose[..., :3, :3].swapaxes(-1, -2) + offset


def wxyz_to_xyzw(quaternions: Array) -> Array:
    """Convert quaternions (..., 4) from wxyz to xyzw."""
    return np.roll(quaternions, -1, axis=-1)


def xyzw_to_wxyz(quaternions: Array) -> Array:
    """Convert quaternions (..., 4) from xyzw to wxyz."""
    return np.roll(quaternions, 1, axis=-1)


def _single_from_wxyz(px: float, py: float, pz: float, w: float, x: float, y: float, z: float) -> Array:
    """Return the transform (4, 4) of one pose; equal to SciPy's result bit for bit, in a tenth of the time."""
    length = math.sqrt(x * x + y * y + z * z + w * w)
    w, x, y, z = w / length, x / length, y / length, z / length
    xx, yy, zz, ww = x * x, y * y, z * z, w * w
    return np.array(
        (
            (xx - yy - zz + ww, 2 * (x * y - z * w), 2 * (x * z + y * w), px),
            (2 * (x * y + z * w), -xx + yy - zz + ww, 2 * (y * z - x * w), py),
            (2 * (x * z - y * w), 2 * (y * z + x * w), -xx - yy + zz + ww, pz),
            (0.0, 0.0, 0.0, 1.0),
        )
    )
