"""Depth as the native video of LeRobot 0.6 and later: 12-bit levels of a range of depths.

Levels written here are mm, so depths up to 4095 mm are exact and farther ones are stored as 4095 mm.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.strict import parse
from robocas_ms3.datasets.lerobot.schema import MAX_DEPTH_MM

_LEVELS = 4096
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
"""Entries of a depth video in ``info.json``: range in m, and how LeRobot's tools encode it again."""
_Metres = Annotated[float, Field(gt=-1e6, lt=1e6, allow_inf_nan=False)]


class _Range(BaseModel):
    """Range of depth of a video; the defaults are LeRobot's."""

    model_config = ConfigDict(strict=True)

    depth_min: _Metres = Field(0.01, alias="video.depth_min")
    depth_max: _Metres = Field(10.0, alias="video.depth_max")
    shift: _Metres = Field(3.5, alias="video.shift")
    use_log: bool = Field(True, alias="video.use_log")

    @model_validator(mode="after")
    def _check_range(self) -> _Range:
        if not self.depth_min < self.depth_max:
            raise ValueError(f"expected depth_min < depth_max, found {self.depth_min:g} and {self.depth_max:g}")
        if self.use_log and self.depth_min + self.shift <= 0:
            raise ValueError(f"expected depth_min + shift > 0, found {self.depth_min:g} and {self.shift:g}")
        return self


def to_levels(depth: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Return the levels of a depth image (H, W) in mm."""
    return np.minimum(depth, np.uint16(MAX_DEPTH_MM))


def to_depth(levels: NDArray[np.uint16], info: Mapping[str, Any]) -> NDArray[np.uint16]:
    """Return the depth in mm of an image of levels (H, W).

    Args:
        levels: 0 to 4095.
        info: ``info`` of the video's feature; missing values are LeRobot's defaults.
    """
    values = parse(_Range, dict(info), DatasetError, where="info", about="invalid range of a depth video")
    low, high, shift = values.depth_min, values.depth_max, values.shift
    share = levels.astype(np.float64) / (_LEVELS - 1)
    if values.use_log:
        first, last = np.log(low + shift), np.log(high + shift)
        metres = np.exp(first + share * (last - first)) - shift
    else:
        metres = low + share * (high - low)
    return np.clip(np.rint(metres * 1000), 0, 65535).astype(np.uint16)
