"""Opens a dataset: arrays, pictures, cameras and provenance of its episodes.

Datasets in upstream's format made elsewhere open too: other types are cast to the schema's, what is missing is made of
what is there (`tolerant`), either name of a camera's pose will do.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.datasets import schema
from robocas_ms3.datasets.pictures.stored import read_picture
from robocas_ms3.datasets.sources.tolerant import complete, load_arrays
from robocas_ms3.errors import DatasetError

_RATE_HZ = 5.0  # upstream's
_SPLIT = "robocas split --in-place --val-share 0.1 makes a new one."
_SEE_VALIDATE = "robocas validate lists all that is wrong."


@dataclass(frozen=True)
class Episode:
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
            complete(loaded, self._said(), self.dataset.rate_hz if self.dataset else _RATE_HZ)
        for key, reason in loaded.unreadable.items():
            if key not in loaded.derived:
                raise DatasetError("this array can't be read", where=f"{path}, {key}", found=reason, fix=_SEE_VALIDATE)
        return loaded.arrays

    def _said(self) -> dict[str, Any]:
        """What ``data_info.json`` says of this episode."""
        if self.dataset is None:
            return {}
        return said_of(self.dataset.info, schema.episode_number(self.folder.name))

    @property
    def steps(self) -> int:
        """T.

        Raises:
            DatasetError: the arrays do not tell.
        """
        if "episode_length" not in self.arrays:
            where = self.folder / schema.EPISODE_FILE
            raise DatasetError("this episode has no length", where=where, expected="episode_length or ee_pos")
        return int(self.arrays["episode_length"])

    @cached_property
    def scene(self) -> dict[str, Any]:
        """``scene.json``; empty where there is none."""
        return _read_json(self.folder / schema.SCENE_FILE)

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
        array = _read_array(self.folder / camera / schema.INTRINSIC_FILE)
        return np.array([array[0, 0], array[1, 1], array[0, 2], array[1, 2]]) if array.shape == (3, 3) else array

    def camera_in_parent(self, camera: str) -> NDArray[np.float64]:
        """(4, 4) OpenCV camera frame in its parent (see ``schema.CAMERAS``), under either name.

        Raises:
            DatasetError: there is neither file, or it is damaged.
        """
        spec = next(spec for spec in schema.CAMERAS if spec.name == camera)
        for name in spec.pose_files:
            if (self.folder / camera / name).is_file():
                return _read_array(self.folder / camera / name)
        raise DatasetError("no pose of this camera", where=self.folder / camera, expected=" or ".join(spec.pose_files))


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
            raise no_dataset(self.root, "folders episode_0000000, ...")

    @cached_property
    def numbers(self) -> list[int]:
        """Numbers of the episodes on disk."""
        if not self.root.is_dir():
            return []
        found = (schema.episode_number(folder.name) for folder in self.root.iterdir() if folder.is_dir())
        return sorted(number for number in found if number is not None)

    @cached_property
    def _known(self) -> frozenset[int]:
        return frozenset(self.numbers)

    @cached_property
    def settings(self) -> dict[str, Any]:
        """``conversion.json``; empty where there is none."""
        return _read_json(self.root / schema.CONVERSION_FILE)

    @cached_property
    def info(self) -> dict[str, Any]:
        """``data_info.json``; empty where there is none."""
        return _read_json(self.root / schema.DATA_INFO_FILE)

    @cached_property
    def sides(self) -> tuple[list[int], list[int]]:
        """Training and validation episodes, as ``data_info.json`` lists them; numbers written as texts count too.

        Raises:
            DatasetError: a list holds something else.
        """
        return self._side("train_eps"), self._side("val_eps")

    def _side(self, key: str) -> list[int]:
        listed = self.info.get(key, [])
        if isinstance(listed, list) and all(type(n) is int or (isinstance(n, str) and n.isdecimal()) for n in listed):
            return [int(n) for n in listed]
        where = f"{self.root / schema.DATA_INFO_FILE}, {key}"
        found = str(listed)[:60]
        raise DatasetError("this split is damaged", where=where, expected="episode numbers", found=found, fix=_SPLIT)

    @property
    def rate_hz(self) -> float:
        """Steps a second: from ``conversion.json``, 5 where there is none."""
        return float(self.settings.get("rate_hz", _RATE_HZ))

    def episode(self, number: int) -> Episode:
        """Open an episode.

        Raises:
            DatasetError: there is none of this number.
        """
        if number not in self._known:
            known = f"{self.numbers[0]} to {self.numbers[-1]}"
            raise DatasetError("no such episode", where=self.root, expected=known, found=number)
        return Episode(self.root / schema.episode_folder(number), self)


def no_dataset(root: Path, expected: str) -> DatasetError:
    """What to say of a folder that is no dataset, with what may have been meant."""
    if (root / "meta" / "info.json").is_file():
        return DatasetError("a LeRobot dataset; this takes RoboCAS folders", where=root)
    meant = near(root)
    fix = f"Did you mean {meant}?" if meant else "Make one with robocas convert."
    return DatasetError("no dataset here", where=root, expected=expected, fix=fix)


def near(root: Path) -> Path | None:
    """The first dataset or recording in a folder."""
    if not root.is_dir():
        return None
    datasets = sorted(root.glob(f"*/{schema.CONVERSION_FILE}")) or sorted(root.glob(f"*/{schema.DATA_INFO_FILE}"))
    return next(iter([path.parent for path in datasets] or sorted(root.glob("*.h5"))), None)


def said_of(info: Mapping[str, Any], number: int | None) -> dict[str, Any]:
    """What ``data_info.json`` says of an episode: its entry under each key that has entries of episodes."""
    tables = {key: info.get(key) for key in ("ep_length", "language_goal", "step_goals")}
    return {k: table[str(number)] for k, table in tables.items() if isinstance(table, dict) and str(number) in table}


def _read_json(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise DatasetError("this JSON is damaged", where=path, found=str(error).splitlines()[0]) from error
    if not isinstance(content, dict):
        raise DatasetError("this JSON is damaged", where=path, expected="an object", found=type(content).__name__)
    return content


def _read_array(path: Path) -> NDArray[np.float64]:
    try:
        array = np.load(path, allow_pickle=False)
        if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu":
            raise ValueError("no array of numbers")
    except (OSError, ValueError, EOFError) as error:
        raise DatasetError(
            "this array can't be read", where=path, found=str(error).splitlines()[0], fix=_SEE_VALIDATE
        ) from error
    return array
