"""Episodes of a RoboCAS dataset, whose pictures are read."""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.datasets import schema
from robocas_ms3.datasets.lerobot.request import OnFrame, Request
from robocas_ms3.datasets.lerobot.schema import needed_arrays, whole_rate
from robocas_ms3.datasets.sources.reader import Dataset, Episode
from robocas_ms3.datasets.sources.tolerant import DAMAGED
from robocas_ms3.datasets.writing.timing import Timing
from robocas_ms3.datasets.writing.writer import CameraModel, Shown
from robocas_ms3.errors import DatasetError


class FolderSource:
    """Reads the episodes of a RoboCAS dataset."""

    def __init__(self, request: Request) -> None:
        """Open the dataset.

        Raises:
            DatasetError: there is none, or other pictures are wanted than it holds.
        """
        self._dataset = Dataset(request.path)
        self._include_failed = request.include_failed
        rate, where = self._dataset.rate_hz, request.path
        if request.rate_hz is not None and abs(request.rate_hz - rate) > 1e-9:
            raise DatasetError(
                "a dataset keeps its rate", where=where, expected=f"{rate:g} Hz", found=f"{request.rate_hz:g}",
                fix="Convert the trajectory at this rate.",
            )  # fmt: skip
        self.fps = whole_rate(rate)
        first = self._dataset.episode(self._dataset.numbers[0])
        self.cameras = tuple(camera for camera in request.pictures.cameras if camera in first.cameras)
        if not self.cameras:
            raise DatasetError(
                "none of these cameras", where=where, expected=first.cameras, found=request.pictures.cameras
            )
        self.depth = request.pictures.depth and first.has_depth
        self._sizes = {camera: _size(first.rgb(camera, 0)) for camera in self.cameras}
        width, height = self._sizes[self.cameras[0]]
        self.size: tuple[int, int] | None = (width, height)
        if request.pictures.size not in (None, self.size):
            raise DatasetError(
                "a dataset keeps its pictures' size", where=where, expected=f"{width} x {height}",
                found=list(request.pictures.size or ()), fix="Convert the trajectory with this size.",
            )  # fmt: skip

    def entries(self) -> list[dict[str, Any]]:
        """Its episodes; those that say they failed only where that was asked for.

        Raises:
            DatasetError: there are none.
        """
        ledger, found = self._dataset.settings.get("episodes", {}), []
        for number in self._dataset.numbers:
            episode = self._dataset.episode(number)
            known = ledger.get(str(number), {})
            success = episode.scene.get("success", known.get("success"))
            if success is False and not self._include_failed:
                continue
            file = episode.folder / schema.EPISODE_FILE
            mark = hashlib.sha256(file.read_bytes()).hexdigest() if file.is_file() else None
            entry = {
                "source": number,
                "trajectory": known.get("trajectory"),
                "trajectory_episode": known.get("trajectory_episode"),
                "seed": episode.scene.get("seed", known.get("seed")),
                "success": success,
                "target": episode.scene.get("target", known.get("target")),
                "recording": (episode.scene.get("source") or {}).get("recording") or known.get("recording") or mark,
            }
            found.append(entry)
        if not found:
            raise DatasetError(
                "no successful episodes to convert", where=self._dataset.root, fix="Pass --include-failed."
            )
        return found

    def sides(self) -> tuple[list[int], list[int]]:
        """Of its split.

        Raises:
            DatasetError: it is damaged.
        """
        return self._dataset.sides

    def play(self, number: int, on_frame: OnFrame, timing: Timing) -> Shown:
        """Read the episode of this number.

        Raises:
            DatasetError: it is damaged, or its pictures are of another size than the dataset's.
        """
        with timing.measure("load"):
            episode = self._dataset.episode(number)
            arrays = _arrays(episode)
        for step in range(episode.steps):
            with timing.measure("load"):
                rgb = {camera: episode.rgb(camera, step) for camera in self.cameras}
                depth = {camera: episode.depth(camera, step) for camera in self.cameras} if self.depth else {}
            for kind, shots in (("rgb", rgb), ("depth", depth)):
                self._check_size(episode, step, kind, shots)
            on_frame(step, rgb, depth)
        cameras = {name: CameraModel(episode.intrinsic(name), episode.camera_in_parent(name)) for name in self.cameras}
        return Shown(arrays, cameras, episode.scene)

    def _check_size(self, episode: Episode, step: int, kind: str, shots: dict[str, NDArray]) -> None:
        """Of every frame: an encoder would take one of another size and scale it."""
        for camera, picture in shots.items():
            if _size(picture) != self._sizes[camera]:
                raise DatasetError(
                    "this picture is not of the dataset's size",
                    where=f"{episode.folder}, {camera}/{kind}, step {step}",
                    expected="{} x {}".format(*self._sizes[camera]),
                    found="{} x {}".format(*_size(picture)),
                    fix="robocas validate lists all that is wrong.",
                )

    def close(self) -> None:
        """Nothing is open."""


def _size(picture: NDArray) -> tuple[int, int]:
    """Width and height."""
    return picture.shape[1], picture.shape[0]


def _arrays(episode: Episode) -> dict[str, NDArray]:
    try:
        arrays = episode.arrays
        missing = sorted(needed_arrays() - set(arrays))
        lengths = {len(arrays[key]) for key in needed_arrays() & set(arrays) if arrays[key].ndim}
    except DAMAGED as error:
        where = episode.folder / schema.EPISODE_FILE
        fix = "robocas validate says what is wrong."
        raise DatasetError(
            "these arrays can't be read", where=where, found=str(error).splitlines()[0], fix=fix
        ) from error
    spoilt = [key for key in sorted(needed_arrays() & set(arrays)) if _holds_nan(arrays[key])]
    if spoilt:
        raise DatasetError(
            "this array holds NaN or infinity",
            where=f"{episode.folder / schema.EPISODE_FILE}, {spoilt[0]}",
            fix="robocas validate lists all that is wrong.",
        )
    if missing or lengths != {episode.steps}:
        raise DatasetError(
            "this episode is not complete",
            where=episode.folder / schema.EPISODE_FILE,
            found=f"no {', '.join(missing)}" if missing else f"lengths {sorted(lengths)}",
            fix="robocas validate says what is wrong.",
        )
    return arrays


def _holds_nan(array: NDArray) -> bool:
    return array.dtype.kind == "f" and not np.isfinite(array).all()
