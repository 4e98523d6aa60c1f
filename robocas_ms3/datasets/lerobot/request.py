"""What is to be converted, and what gives its episodes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from numpy.typing import NDArray

from robocas_ms3.datasets.pictures.stored import Pictures
from robocas_ms3.datasets.writing.timing import Timing
from robocas_ms3.datasets.writing.workers import OpenSource
from robocas_ms3.datasets.writing.writer import Shown

OnFrame = Callable[[int, dict[str, NDArray], dict[str, NDArray]], None]
"""Takes step, and pictures by camera: (H, W, 3) uint8 RGB, (H, W) uint16 depth in mm."""


@dataclass(frozen=True)
class Request:
    """What is to be converted; can be sent to another process.

    Attributes:
        path: F.h5, or the folder of a RoboCAS dataset.
        rate_hz: steps a second; None: 5, or the folder's.
        pictures: cameras, size and depth.
        include_failed: also episodes without success.
        open_source: makes what shows a trajectory's states.
        pack: of the objects, instead of what a trajectory names.
    """

    path: Path
    rate_hz: float | None
    pictures: Pictures
    include_failed: bool
    open_source: OpenSource
    pack: str | Path | None = None


class EpisodeSource(Protocol):
    """Gives episodes, one at a time."""

    fps: int
    cameras: tuple[str, ...]
    depth: bool
    size: tuple[int, int] | None

    def entries(self) -> list[dict[str, Any]]:
        """Of each episode, in order, what tells it from others; ``source`` is its number for `play`."""
        ...

    def sides(self) -> tuple[list[int], list[int]]:
        """``source`` of the training and validation episodes, as far as that was settled before."""
        ...

    def play(self, number: int, on_frame: OnFrame, timing: Timing) -> Shown:
        """Hand over an episode's pictures, then the rest."""
        ...

    def close(self) -> None:
        """Free what it holds."""
        ...
