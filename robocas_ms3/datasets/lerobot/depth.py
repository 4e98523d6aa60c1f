"""Depth as LeRobot's native video (LeRobot 0.6 and later): 12-bit levels that stand for a range of depths.

Written here: level = depth in mm, so depths up to 4095 mm are exact and farther ones are stored as 4095 mm.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.datasets.lerobot.schema import MAX_DEPTH_MM
from robocas_ms3.errors import DatasetError

LEVELS = 4096
DEPTH_INFO: Mapping[str, Any] = {
    "is_depth_map": True,
    "depth_unit": "mm",
    "video.depth_min": 0.0,
    "video.depth_max": MAX_DEPTH_MM / 1000,
    "video.shift": 0.0,
    "video.use_log": False,
    "video.g": 2,
    "video.preset": "ultrafast",
    "video.extra_options": {"x265-params": "lossless=1"},
}
"""What ``info.json`` says of a depth video besides its stream: range in m, and how LeRobot's tools encode it again."""
_LEROBOT = {"video.depth_min": 0.01, "video.depth_max": 10.0, "video.shift": 3.5, "video.use_log": True}


def to_levels(depth: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Return the levels of a depth image (H, W) in mm."""
    return np.minimum(depth, np.uint16(MAX_DEPTH_MM))


def to_depth(levels: NDArray[np.uint16], info: Mapping[str, Any]) -> NDArray[np.uint16]:
    """Return the depth in mm of an image of levels (H, W).

    Args:
        levels: 0 to 4095.
        info: ``info`` of the video's feature; missing values are LeRobot's defaults.

    Raises:
        DatasetError: the range is none.
    """
    low, high, shift, log = (info.get(key, default) for key, default in _LEROBOT.items())
    numbers = all(isinstance(value, int | float) and abs(value) < 1e6 for value in (low, high, shift))
    if not numbers or not low < high or (log and low + shift <= 0):
        found = {"depth_min": low, "depth_max": high, "shift": shift}
        raise DatasetError(
            "invalid range of a depth video", where="info", expected="depth_min < depth_max", found=found
        )
    share = levels.astype(np.float64) / (LEVELS - 1)
    if log:
        first, last = np.log(low + shift), np.log(high + shift)
        metres = np.exp(first + share * (last - first)) - shift
    else:
        metres = low + share * (high - low)
    return np.clip(np.rint(metres * 1000), 0, 65535).astype(np.uint16)
