"""Opens a dataset: arrays, pictures, cameras and provenance of its episodes."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.datasets import schema
from robocas_ms3.datasets.pictures import read_picture
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

    @cached_property
    def scene(self) -> dict[str, Any]:
        """``scene.json``; empty where there is none."""
        path = self.folder / schema.SCENE_FILE
        return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}

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
        """(4,) fx, fy, cx, cy in pixels."""
        return np.load(self.folder / camera / schema.INTRINSIC_FILE, allow_pickle=False)

    def camera_in_parent(self, camera: str) -> NDArray[np.float64]:
        """(4, 4) OpenCV camera frame in its parent (see ``schema.CAMERAS``), under either name.

        Raises:
            DatasetError: there is neither file.
        """
        spec = next(spec for spec in schema.CAMERAS if spec.name == camera)
        for name in spec.pose_files:
            if (self.folder / camera / name).is_file():
                return np.load(self.folder / camera / name, allow_pickle=False)
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
            raise DatasetError("no dataset here", where=self.root, expected="folders episode_0000000, ...")

    @cached_property
    def numbers(self) -> list[int]:
        """Numbers of the episodes on disk."""
        if not self.root.is_dir():
            return []
        found = (schema.episode_number(folder.name) for folder in self.root.iterdir() if folder.is_dir())
        return sorted(number for number in found if number is not None)

    @cached_property
    def settings(self) -> dict[str, Any]:
        """``conversion.json``; empty where there is none."""
        return _read_json(self.root / schema.CONVERSION_FILE)

    @cached_property
    def info(self) -> dict[str, Any]:
        """``data_info.json``; empty where there is none."""
        return _read_json(self.root / schema.DATA_INFO_FILE)

    @property
    def rate_hz(self) -> float:
        """Steps a second: from ``conversion.json``, 5 where there is none."""
        return float(self.settings.get("rate_hz", 5.0))

    def episode(self, number: int) -> Episode:
        """Open an episode.

        Raises:
            DatasetError: there is none of this number.
        """
        if number not in self.numbers:
            known = f"{self.numbers[0]} to {self.numbers[-1]}"
            raise DatasetError("no such episode", where=self.root, expected=known, found=number)
        return Episode(self.root / schema.episode_folder(number))


def _read_json(path: Path) -> dict[str, Any]:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}
    except ValueError as error:
        raise DatasetError("this JSON is damaged", where=path, found=str(error).splitlines()[0]) from error
