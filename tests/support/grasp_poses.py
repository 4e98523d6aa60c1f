"""Grasp poses for an arm base at the origin and an object 0.5 m in front of it (along x)."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

BASE = np.eye(4)
CENTER = np.array([0.5, 0.0, 0.05])
NO_POINTS = np.zeros((0, 3))


def grasp(lean_deg=0.0, heading_deg=0.0, closing_deg=0.0, at=CENTER):
    """Return a grasp tilted from straight down towards a heading, turned by ``closing_deg`` about its approach axis."""
    heading = np.deg2rad(heading_deg)
    across = np.array([-np.sin(heading), np.cos(heading), 0.0])
    down = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))
    turn = (
        Rotation.from_rotvec(-np.deg2rad(lean_deg) * across)
        * down
        * Rotation.from_euler("z", closing_deg, degrees=True)
    )
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn.as_matrix(), at
    return pose
