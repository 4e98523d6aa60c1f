"""Open a trajectory file or a dataset of any format for the page."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.formats import format_of
from robocas_ms3.datasets.pictures.headers import read_picture_bytes
from robocas_ms3.datasets.sources.reader import DEFAULT_RATE, Dataset
from robocas_ms3.viewer.content import PageContent
from robocas_ms3.viewer.damage import attempt, rate_of, split_of, table
from robocas_ms3.viewer.pictures import Picture, inside
from robocas_ms3.viewer.trajectory import TrajectoryContent

MEDIA_TYPES = {".png": "image/png", ".jpg": "image/jpeg", ".webp": "image/webp"}


class FolderContent(PageContent):
    """A RoboCAS folder, of this package or of RoboCAS-v0; images are sent as they are stored."""

    def __init__(self, root: Path) -> None:
        """Open it.

        Raises:
            DatasetError: there are no episodes.
        """
        self.dataset = dataset = Dataset(root)
        # damaged values of the overviews are left out from here on
        dataset.settings, wrong_settings = table(lambda: dataset.settings, schema.CONVERSION_FILE)
        dataset.info, wrong_info = table(lambda: dataset.info, schema.DATA_INFO_FILE)
        dataset.rate_hz, wrong_rate = rate_of(dataset.settings, schema.CONVERSION_FILE, DEFAULT_RATE)
        dataset.cameras, _ = attempt(lambda: dataset.cameras, dataset.episode(dataset.numbers[0]).cameras)
        notes = wrong_settings, wrong_rate, wrong_info
        super().__init__(dataset, "RoboCAS folder", notes=notes, split=split_of(dataset.info))

    def rgb(self, number: int, camera: str, step: int) -> Picture:
        """Return the file of an image, not decoded."""
        path = inside(self.dataset.episode(number).image_path(camera, "rgb", step), self.root)
        try:
            return Picture(MEDIA_TYPES[path.suffix], read_picture_bytes(path))
        except (OSError, ValueError) as error:
            found = getattr(error, "strerror", None) or error
            raise DatasetError("can't read this picture", where=path, found=found) from error

    def depth(self, number: int, camera: str, step: int) -> NDArray[np.uint16]:
        """Return (H, W) depth in mm; 0: no measurement."""
        episode = self.dataset.episode(number)
        inside(episode.image_path(camera, "depth", step), self.root)
        return episode.depth(camera, step)


def open_source(path: Path | str) -> PageContent:
    """Open a trajectory file or its folder, a RoboCAS folder, a LeRobot folder, or another package's format.

    Raises:
        DatasetError: it is none of them, or damaged.
    """
    path = Path(path)
    inside = path / "trajectory.h5"
    path = inside if inside.is_file() else path
    found = format_of(path)
    other_file = found is None or (found.name == "trajectory" and path.suffix not in (".h5", ".hdf5"))
    if other_file and not path.is_dir():
        raise DatasetError(
            "nothing to view here",
            where=path,
            expected="a trajectory.h5 of robocas generate, a RoboCAS folder or a LeRobot folder",
            found="no such file or folder" if not path.exists() else "another kind of file",
        )
    if found is None or found.name == "robocas":
        return FolderContent(path)
    if found.name == "trajectory":
        return TrajectoryContent(path)
    if found.name == "lerobot":
        from robocas_ms3.viewer.lerobot import LeRobotContent  # needs the extra `lerobot`

        return LeRobotContent(path)
    return PageContent(found.part("reader")(path), found.title)
