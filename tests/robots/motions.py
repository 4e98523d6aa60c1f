"""Motions between poses."""

from __future__ import annotations

import numpy as np
from mani_skill.utils.structs import Pose
from scipy.spatial.transform import Rotation


def matrix(pose: Pose) -> np.ndarray:
    return pose.sp.to_transformation_matrix()


def moved(start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Translation and rotation vector of a motion, in the frame at its start."""
    relative = np.linalg.inv(start) @ end
    return relative[:3, 3], Rotation.from_matrix(relative[:3, :3]).as_rotvec()
