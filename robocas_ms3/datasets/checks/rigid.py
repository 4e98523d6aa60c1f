"""Rigid transforms as a dataset stores them: what counts as one, and how far two are apart."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

NORM_TOLERANCE = 1e-3  # of unit vectors and quaternions
POSITION_TOLERANCE = 1e-4  # m
ANGLE_TOLERANCE = 1e-3  # rad


def is_rigid(matrix: NDArray) -> bool:
    """Whether a matrix is a rigid transform, (4, 4)."""
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        return False
    rotation = matrix[:3, :3]
    return bool(
        np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4)
        and np.linalg.det(rotation) > 0
        and np.allclose(matrix[3], [0, 0, 0, 1], atol=1e-6)
    )


def apart(expected: NDArray, found: NDArray) -> tuple[NDArray, NDArray]:
    """Distance in m and angle in rad, each (T,), between two lots of poses (T, 4, 4)."""
    turn = Rotation.from_matrix(np.swapaxes(expected[:, :3, :3], 1, 2) @ found[:, :3, :3]).magnitude()
    return np.linalg.norm(expected[:, :3, 3] - found[:, :3, 3], axis=1), turn


def same(expected: NDArray, found: NDArray) -> NDArray[np.bool_]:
    """(T,) which of two lots of poses (T, 4, 4) agree within the tolerances."""
    shift, turn = apart(expected, found)
    return (shift <= POSITION_TOLERANCE) & (turn <= ANGLE_TOLERANCE)
