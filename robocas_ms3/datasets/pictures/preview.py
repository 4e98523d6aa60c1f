"""Previews of a dataset that is being written, made from the frames as they pass."""

from __future__ import annotations

import time
from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.files import make_folder, replacing
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.pictures.drawing import Pictures, Story, draw_frame, draw_row, row_steps
from robocas_ms3.datasets.pictures.video import SHEET, open_video, sheet_row, write_sheet
from robocas_ms3.datasets.sources.reader import Dataset

FEW = 20
"""Of so many episodes previews are made without being asked for."""
PANEL = (320, 240)
"""Width and height of one camera's picture in a preview."""
# Of a preview x264's default preset takes three times as long, and its threads get in the renderer's way.
_FFMPEG = ("-preset", "veryfast", "-threads", "1")


class Preview:
    """Video of one episode, and its part of the contact sheet; the video appears whole, at the end of the ``with``.

    Attributes:
        row: (H, W, 3) RGB, after the last frame.
    """

    def __init__(self, root: Path, rate_hz: float, story: Story, *, row: bool) -> None:
        """Begin.

        Args:
            root: the dataset.
            rate_hz: steps a second.
            story: of the episode.
            row: whether it is on the contact sheet.
        """
        self.row: NDArray[np.uint8] | None = None
        self._path = make_folder(root / schema.PREVIEW_FOLDER) / f"{schema.episode_folder(story.number)}.mp4"
        self._story, self._rate_hz = story, rate_hz
        self._wanted = set(row_steps(story.steps)) if row else set()
        self._shown: dict[int, Pictures] = {}
        self._stack = ExitStack()
        self._video: Any = None

    def __enter__(self) -> Preview:
        """Open the video."""
        with ExitStack() as stack:
            tmp = stack.enter_context(replacing(self._path))
            self._video = stack.enter_context(open_video(tmp, self._rate_hz, *_FFMPEG, quality=6))
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *error: Any) -> None:
        """Finish it."""
        self._stack.__exit__(*error)

    def add(self, step: int, rgb: Pictures) -> float:
        """Take the next step's pictures; gives the seconds that took."""
        begun = time.perf_counter()
        self._video.append_data(draw_frame(self._story, step, rgb, PANEL))
        if step in self._wanted:
            self._shown[step] = rgb
            if step == self._story.steps - 1:
                self.row = draw_row(self._story, self._shown, self._rate_hz)
                self._shown = {}
        return time.perf_counter() - begun


def on_sheet(numbers: Iterable[int]) -> tuple[int, ...]:
    """Which of a dataset's episodes are on its contact sheet."""
    return tuple(sorted(numbers)[:SHEET])


def finish_previews(root: Path, rows: dict[int, NDArray[np.uint8]]) -> None:
    """Write the contact sheet, unless it is there and nothing is new; what is not new is drawn of its stored pictures.

    Args:
        root: the dataset, whole.
        rows: of the episodes written now.
    """
    path = root / schema.PREVIEW_FOLDER / "contact_sheet.png"
    if not rows and path.is_file():
        return
    dataset = Dataset(root)
    numbers = on_sheet(dataset.numbers)
    write_sheet([rows[number] if number in rows else sheet_row(dataset, number) for number in numbers], path)
