"""The EEF frame of datasets made elsewhere: upstream's TCP is ManiSkill's turned by -90 degrees about z."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocas_ms3.datasets import schema
from robocas_ms3.datasets.sources.arrays import continuous_xyzw
from robocas_ms3.datasets.sources.tolerant import SPECS, EpisodeArrays, motion_arrays

_CAMERA_OFFSET = (0.03, 0.07)  # m: the gripper camera's distance from the hand's axis, 0.05


def eef_turn(camera_in_ee: NDArray) -> int:
    """By how much an EEF frame has to be turned about its z to be ManiSkill's TCP: 0, 90, 180 or -90 degrees.

    The gripper camera sits 0.05 m from the hand's axis, on the x side of ManiSkill's TCP; where it is elsewhere,
    nothing is known, and the frame stays.
    """
    x, y = camera_in_ee[:2, 3]
    if not _CAMERA_OFFSET[0] < np.hypot(x, y) < _CAMERA_OFFSET[1]:
        return 0
    angle = np.rad2deg(np.arctan2(y, x))
    quarter = round(angle / 90)
    return (quarter % 4 if quarter % 4 != 3 else -1) * 90 if abs(angle - quarter * 90) < 5 else 0


def about_z(degrees: float) -> NDArray[np.float64]:
    """(4, 4) turn about z."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    return matrix


def turned(stored: EpisodeArrays, degrees: float) -> EpisodeArrays:
    """The same with the EEF frame turned about its own z."""
    turns = Rotation.from_quat(stored.arrays["ee_orn"]) * Rotation.from_euler("z", degrees, degrees=True)
    arrays = {**stored.arrays, "ee_orn": SPECS["ee_orn"].cast(continuous_xyzw(turns.as_matrix()))}
    return replace(stored, arrays={**arrays, **motion_arrays(arrays, schema.RELATIVE_PAIRS[0])})
