"""One episode's folder: arrays, pictures, cameras and provenance.

Episodes in upstream's format made elsewhere open too: other types are cast to the schema's, what is missing is made of
what is there (`tolerant`), either name of a camera's pose will do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.pictures.stored import read_picture
from robocas_ms3.datasets.sources.files import SEE_VALIDATE, read_array, read_json, said_of
from robocas_ms3.datasets.sources.protocol import SourceEpisode
from robocas_ms3.datasets.sources.tolerant import completed, is_declared, load_arrays, read_arrays
from robocas_ms3.demos.recordings.subgoals import SubGoal, read_subgoals

if TYPE_CHECKING:
    from robocas_ms3.datasets.sources.reader import Dataset

DEFAULT_RATE = 5.0  # upstream's, Hz


@dataclass(frozen=True)
class Episode(SourceEpisode):
    """One episode's folder.

    Attributes:
        folder: its path.
        dataset: it is in; says what is not in the folder.
    """

    folder: Path
    dataset: Dataset | None = field(default=None, repr=False, compare=False)

    @cached_property
    def arrays(self) -> dict[str, NDArray]:
        """``episode_info.npz``, by the schema's keys and of its types; what is missing is made where it can be.

        Raises:
            DatasetError: the file is damaged, or an array is: pickled, or of another type.
        """
        path = self.folder / schema.EPISODE_FILE
        loaded = load_arrays(path)
        if any(spec.name not in loaded.arrays for spec in schema.EPISODE_INFO if not spec.embedding):
            loaded = completed(loaded, self._said(), self.dataset.rate_hz if self.dataset else DEFAULT_RATE)
        for key in set(loaded.unreadable) - set(loaded.derived):
            where, found = f"{path}, {key}", loaded.reason(key)
            raise DatasetError("this array can't be read", where=where, found=found, fix=SEE_VALIDATE)
        return dict(loaded.arrays)

    def read(self, keys: Sequence[str]) -> dict[str, NDArray]:
        """Some of the arrays.

        Raises:
            DatasetError: the file or one of them is missing or damaged.
        """
        found = read_arrays(self.folder / schema.EPISODE_FILE, keys)
        if found.unreadable or all(key in found.arrays and is_declared(key, found.arrays[key]) for key in keys):
            return found.needed(keys)
        return replace(found, arrays=self.arrays).needed(keys)  # slower; casts and completes what was made elsewhere

    @property
    def goals(self) -> list[SubGoal]:
        """Sub-goals, as ``data_info.json`` has them; empty where it has none."""
        where = f"{self.folder.parent / schema.DATA_INFO_FILE}, step_goals.{schema.episode_number(self.folder.name)}"
        return read_subgoals(self._said().get("step_goals", []), where)

    def _said(self) -> dict[str, Any]:
        """What ``data_info.json`` says of this episode."""
        if self.dataset is None:
            return {}
        return said_of(self.dataset.info, schema.episode_number(self.folder.name))

    @property
    def where(self) -> Path:
        """Its folder."""
        return self.folder

    @property
    def steps(self) -> int:
        """T.

        Raises:
            DatasetError: the arrays do not tell.
        """
        return int(self.read(["episode_length"])["episode_length"])

    @property
    def instruction(self) -> str:
        """What the robot was told: by ``data_info.json``, else by the arrays.

        Raises:
            DatasetError: neither tells.
        """
        said = self._said().get("language_goal")
        return said if isinstance(said, str) else str(self.read(["language_goal"])["language_goal"])

    @cached_property
    def scene(self) -> dict[str, Any]:
        """``scene.json``; empty where there is none."""
        return read_json(self.folder / schema.SCENE_FILE)

    @cached_property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras that are there."""
        return tuple(camera.name for camera in schema.CAMERAS if (self.folder / camera.name).is_dir())

    @cached_property
    def has_depth(self) -> bool:
        """Whether depth is there."""
        return any((self.folder / camera / "depth").is_dir() for camera in self.cameras)

    @cached_property
    def image_format(self) -> schema.ImageFormat:
        """Of RGB, by the first picture that is there."""
        for camera in self.cameras:
            for image_format in schema.IMAGE_FORMATS:
                if schema.image_path(self.folder, camera, "rgb", 0, image_format).is_file():
                    return image_format
        return "png"

    def image_path(self, camera: str, kind: str, step: int) -> Path:
        """Path of a picture; ``kind`` is ``rgb`` or ``depth``."""
        return schema.image_path(self.folder, camera, kind, step, self.image_format)

    def rgb(self, camera: str, step: int) -> NDArray[np.uint8]:
        """(H, W, 3) RGB."""
        return read_picture(self.image_path(camera, "rgb", step))

    def depth(self, camera: str, step: int) -> NDArray[np.uint16]:
        """(H, W) mm, 0 = nothing."""
        return read_picture(self.image_path(camera, "depth", step))

    def intrinsic(self, camera: str) -> NDArray[np.float64]:
        """(4,) fx, fy, cx, cy in pixels; a 3x3 camera matrix is read as such.

        Raises:
            DatasetError: the file is missing or damaged.
        """
        array = read_array(self.folder / camera / schema.INTRINSIC_FILE)
        return np.array([array[0, 0], array[1, 1], array[0, 2], array[1, 2]]) if array.shape == (3, 3) else array

    def camera_in_parent(self, camera: str) -> NDArray[np.float64]:
        """(4, 4) OpenCV camera frame in its parent (see ``schema.CAMERAS``), under either name.

        Raises:
            DatasetError: there is neither file, or it is damaged.
        """
        spec = next(spec for spec in schema.CAMERAS if spec.name == camera)
        for name in spec.pose_files:
            if (self.folder / camera / name).is_file():
                return read_array(self.folder / camera / name)
        raise DatasetError("no pose of this camera", where=self.folder / camera, expected=" or ".join(spec.pose_files))
