"""What cameras saw, on its way from what shows it to what writes it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.datasets.pictures.boxes import Box
from robocas_ms3.datasets.pictures.stored import Pictures
from robocas_ms3.demos.recordings.environment import RecordedEnv
from robocas_ms3.demos.recordings.reading import Recording


@dataclass(frozen=True)
class CameraModel:
    """What does not change during an episode.

    Attributes:
        intrinsic: (4,) fx, fy, cx, cy, pixels.
        camera_in_parent: (4, 4) OpenCV camera frame.
    """

    intrinsic: NDArray[np.float64]
    camera_in_parent: NDArray[np.float64]


@dataclass(frozen=True)
class Frame:
    """What is seen at one state.

    Attributes:
        rgb: camera -> (H, W, 3) uint8.
        depth: camera -> (H, W) uint16, mm; empty where depth is not wanted.
        boxes: camera -> box of the target's visible pixels, of the cameras that see it; empty where boxes are not
            wanted or not known.
    """

    rgb: dict[str, NDArray[np.uint8]]
    depth: dict[str, NDArray[np.uint16]]
    boxes: dict[str, Box] = field(default_factory=dict)


class FrameSource(Protocol):
    """Shows recorded states; the renderer is one, tests bring another."""

    def load(self, recording: Recording) -> None:
        """Build the recording's scene."""
        ...

    def frames(self, recording: Recording, samples: NDArray[np.int64]) -> Iterator[Frame]:
        """Show some of its states."""
        ...

    def cameras(self) -> dict[str, CameraModel]:
        """The cameras, at the state shown last."""
        ...

    def scene(self) -> dict[str, Any]:
        """What ``scene.json`` says of the scene: ``task``, ``config``, ``layout``, ``objects``."""
        ...

    def close(self) -> None:
        """Free what it holds."""
        ...


OpenSource = Callable[[RecordedEnv, str, Pictures], FrameSource]
"""Makes a frame source from what was recorded in, control mode and what is to be rendered."""
