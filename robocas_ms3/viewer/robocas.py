"""A RoboCAS folder, of ours or of upstream's, on the page."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.pictures.headers import read_picture_bytes
from robocas_ms3.datasets.sources.episode import DEFAULT_RATE
from robocas_ms3.datasets.sources.reader import Dataset
from robocas_ms3.viewer.content import PageContent
from robocas_ms3.viewer.damage import attempt, rate_of, split_of, table
from robocas_ms3.viewer.parts import Picture
from robocas_ms3.viewer.pictures import inside

MEDIA_TYPES = {".png": "image/png", ".jpg": "image/jpeg", ".webp": "image/webp"}


class FolderContent(PageContent):
    """A dataset's folder; pictures are handed on as they are stored."""

    def __init__(self, root: Path) -> None:
        """Open it.

        Raises:
            DatasetError: there are no episodes.
        """
        self.dataset = dataset = Dataset(root)
        # what is damaged of the overviews is left out from here on
        dataset.settings, wrong_settings = table(lambda: dataset.settings, schema.CONVERSION_FILE)
        dataset.info, wrong_info = table(lambda: dataset.info, schema.DATA_INFO_FILE)
        dataset.rate_hz, wrong_rate = rate_of(dataset.settings, schema.CONVERSION_FILE, DEFAULT_RATE)
        dataset.cameras, _ = attempt(lambda: dataset.cameras, dataset.episode(dataset.numbers[0]).cameras)
        notes = wrong_settings, wrong_rate, wrong_info
        super().__init__(dataset, "RoboCAS folder", notes=notes, split=split_of(dataset.info))

    def rgb(self, number: int, camera: str, step: int) -> Picture:
        """A picture's file, not decoded."""
        path = inside(self.dataset.episode(number).image_path(camera, "rgb", step), self.root)
        try:
            return Picture(MEDIA_TYPES[path.suffix], read_picture_bytes(path))
        except (OSError, ValueError) as error:
            found = getattr(error, "strerror", None) or error
            raise DatasetError("can't read this picture", where=path, found=found) from error

    def depth(self, number: int, camera: str, step: int) -> NDArray[np.uint16]:
        """A picture's file, decoded: (H, W) mm, 0 = nothing."""
        episode = self.dataset.episode(number)
        inside(episode.image_path(camera, "depth", step), self.root)
        return episode.depth(camera, step)
