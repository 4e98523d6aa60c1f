"""The EEF frame of datasets made elsewhere: upstream's TCP is ManiSkill's turned by -90 degrees about z."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocas_ms3.datasets import schema
from robocas_ms3.datasets.sources.tolerant import SPECS, derive_motion

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


def turn(arrays: dict[str, NDArray], degrees: float) -> None:
    """Turn the EEF frame of an episode about its own z."""
    turned = Rotation.from_quat(arrays["ee_orn"]) * Rotation.from_euler("z", degrees, degrees=True)
    quaternions = turned.as_quat()
    kept = np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0
    quaternions[1:] *= np.where(np.cumsum(kept) % 2, -1.0, 1.0)[:, None]
    arrays["ee_orn"] = SPECS["ee_orn"].cast(quaternions * (1 if quaternions[0, 3] >= 0 else -1))
    derive_motion(arrays, schema.RELATIVE_PAIRS[0])
