"""Opens a dataset for looking at it: arrays and pictures of its episodes."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from robocas_ms3.datasets import schema
from robocas_ms3.errors import DatasetError


@dataclass(frozen=True)
class Episode:
    """One episode's folder."""

    folder: Path

    @cached_property
    def arrays(self) -> dict[str, NDArray]:
        """Everything in ``episode_info.npz``, by the schema's keys."""
        with np.load(self.folder / schema.EPISODE_FILE, allow_pickle=False) as content:
            return {key: content[key] for key in content.files}

    @property
    def steps(self) -> int:
        """T."""
        return int(self.arrays["episode_length"])

    def rgb(self, camera: str, step: int) -> NDArray[np.uint8]:
        """(H, W, 3) RGB."""
        return cv2.cvtColor(self._picture(camera, "rgb", step), cv2.COLOR_BGR2RGB)  # type: ignore[return-value]

    def depth(self, camera: str, step: int) -> NDArray[np.uint16]:
        """(H, W) mm, 0 = nothing."""
        return self._picture(camera, "depth", step)

    def _picture(self, camera: str, kind: str, step: int) -> NDArray[Any]:
        path = schema.image_path(self.folder, camera, kind, step)
        picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        if picture is None:
            raise DatasetError("can't read this picture", where=path, fix="robocas validate lists all that is wrong.")
        return np.asarray(picture)


@dataclass(frozen=True)
class Dataset:
    """A dataset's folder."""

    root: Path

    def __post_init__(self) -> None:
        """Check that there is something.

        Raises:
            DatasetError: no episodes there.
        """
        if not self.numbers:
            raise DatasetError("no dataset here", where=self.root, expected="folders episode_0000000, ...")

    @cached_property
    def numbers(self) -> list[int]:
        """Numbers of the episodes on disk."""
        if not self.root.is_dir():
            return []
        found = (schema.episode_number(folder.name) for folder in self.root.iterdir() if folder.is_dir())
        return sorted(number for number in found if number is not None)

    @cached_property
    def rate_hz(self) -> float:
        """Steps a second: from ``conversion.json``, 5 where there is none."""
        path = self.root / schema.CONVERSION_FILE
        return float(json.loads(path.read_text(encoding="utf-8"))["rate_hz"]) if path.is_file() else 5.0

    def episode(self, number: int) -> Episode:
        """Open an episode.

        Raises:
            DatasetError: there is none of this number.
        """
        if number not in self.numbers:
            known = f"{self.numbers[0]} to {self.numbers[-1]}"
            raise DatasetError("no such episode", where=self.root, expected=known, found=number)
        return Episode(self.root / schema.episode_folder(number))
