"""Plays the episodes of a dataset, whose pictures are read."""

from __future__ import annotations

from collections.abc import Generator, Mapping
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.documents import DAMAGED
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.formats import open_source
from robocas_ms3.datasets.pictures.stored import Pictures
from robocas_ms3.datasets.sources.protocol import EpisodeSource, Kind, SourceEpisode, shots
from robocas_ms3.datasets.sources.tolerant import arrays_fingerprint
from robocas_ms3.datasets.writing.frames import CameraModel, Frame
from robocas_ms3.datasets.writing.players import Played, Player, RecordingPlayer, Request
from robocas_ms3.datasets.writing.timing import Timing

NEEDED = frozenset(s.name for s in schema.EPISODE_INFO if not s.embedding) - {"base_rel_pos", "base_rel_orn"}
"""Arrays that an episode must have to be converted."""
_VALIDATE = "robocas validate lists all that is wrong."


class DatasetPlayer:
    """Reads the episodes of a dataset.

    Raises:
        DatasetError: other pictures are wanted than it holds, or another rate.
    """

    def __init__(self, source: EpisodeSource, request: Request) -> None:
        self._source, self._include_failed = source, request.include_failed
        self.rate_hz, where, wanted = source.rate_hz, source.root, request.pictures
        if request.rate_hz is not None and abs(request.rate_hz - self.rate_hz) > 1e-9:
            found, expected = f"{request.rate_hz:g}", f"{self.rate_hz:g} Hz"
            fix = "Convert the trajectory at this rate."
            raise DatasetError("a dataset keeps its rate", where=where, expected=expected, found=found, fix=fix)
        first = source.episode(source.numbers[0])
        cameras = tuple(camera for camera in wanted.cameras if camera in first.cameras)
        if not cameras:
            raise DatasetError("none of these cameras", where=where, expected=first.cameras, found=wanted.cameras)
        self._sizes = {camera: _size(first.rgb(camera, 0)) for camera in cameras}
        width, height = size = self._sizes[cameras[0]]
        if wanted.size not in (None, size):
            raise DatasetError(
                "a dataset keeps its pictures' size",
                where=where,
                expected=f"{width} x {height}",
                found=list(wanted.size or ()),
                fix="Convert the trajectory with this size.",
            )
        self.pictures = replace(wanted, cameras=cameras, size=size, depth=wanted.depth and source.has_depth)

    def entries(self) -> list[dict[str, Any]]:
        """Its episodes; those that say they failed only where that was asked for.

        Raises:
            DatasetError: there are none.
        """
        found = []
        for number in self._source.numbers:
            episode, known = self._source.episode(number), self._source.entry(number)
            scene = episode.scene
            success = scene.get("success", known.get("success"))
            if success is False and not self._include_failed:
                continue
            mark = (scene.get("source") or {}).get("recording") or known.get("recording")
            entry = {
                "source": number,
                "trajectory": known.get("trajectory"),
                "trajectory_episode": known.get("trajectory_episode"),
                "seed": scene.get("seed", known.get("seed")),
                "success": success,
                "target": scene.get("target", known.get("target")),
                "recording": mark or f"arrays {arrays_fingerprint(_arrays(episode))}",
            }
            found.append(entry)
        if not found:
            fix = "Pass --include-failed."
            raise DatasetError("no successful episodes to convert", where=self._source.root, fix=fix)
        return found

    def texts(self, number: int) -> list[str]:
        """Instruction and sub-goals."""
        arrays = self._source.episode(number).read(("language_goal", "step_lang_goals"))
        return [str(arrays["language_goal"]), *arrays["step_lang_goals"].tolist()]

    def sides(self) -> tuple[list[int], list[int]]:
        """Of its split."""
        return self._source.split("train"), self._source.split("val")

    def open(self, number: int, timing: Timing) -> Played:
        """Read the episode of this number.

        Raises:
            DatasetError: it is damaged.
        """
        with timing.measure("load"):
            episode = self._source.episode(number)
            return _PlayedEpisode(episode, _arrays(episode), self._sizes, self.pictures, timing)

    def close(self) -> None:
        """Nothing is open."""


@dataclass(frozen=True)
class _PlayedEpisode:
    episode: SourceEpisode
    arrays: dict[str, NDArray]
    sizes: dict[str, tuple[int, int]]
    pictures: Pictures
    timing: Timing

    def frames(self) -> Generator[Frame, None, None]:
        """Read every step's; an encoder would take one of another size and scale it, so that is checked.

        Raises:
            DatasetError: one is damaged, or of another size than the dataset's.
        """
        kinds: tuple[Kind, ...] = ("rgb", "depth") if self.pictures.depth else ("rgb",)
        boxes = self.episode.target_boxes if self.pictures.boxes else []
        with ExitStack() as stack:
            cameras = tuple(self.sizes)
            runs = {kind: stack.enter_context(closing(shots(self.episode, cameras, kind))) for kind in kinds}
            for step in range(self.episode.steps):
                with self.timing.measure("load"):
                    found = {kind: next(run) for kind, run in runs.items()}
                for kind, pictures in found.items():
                    self._check_sizes(kind, step, pictures)
                yield Frame(found["rgb"], found.get("depth", {}), boxes[step] if boxes else {})

    def _check_sizes(self, kind: str, step: int, pictures: Mapping[str, NDArray]) -> None:
        for camera, picture in pictures.items():
            if _size(picture) != self.sizes[camera]:
                raise DatasetError(
                    "this picture is not of the dataset's size",
                    where=f"{self.episode.where}, {camera}/{kind}, step {step}",
                    expected="{} x {}".format(*self.sizes[camera]),
                    found="{} x {}".format(*_size(picture)),
                    fix=_VALIDATE,
                )

    def cameras(self) -> dict[str, CameraModel]:
        episode = self.episode
        return {name: CameraModel(episode.intrinsic(name), episode.camera_in_parent(name)) for name in self.sizes}

    def scene(self) -> dict[str, Any]:
        return self.episode.scene


def _size(picture: NDArray) -> tuple[int, int]:
    """Width and height."""
    return picture.shape[1], picture.shape[0]


def _arrays(episode: SourceEpisode) -> dict[str, NDArray]:
    """All arrays, which are whole and numbers."""
    fix = "robocas validate says what is wrong."
    try:
        arrays = episode.arrays
    except DAMAGED as error:
        found = str(error).splitlines()[0]
        raise DatasetError("these arrays can't be read", where=episode.where, found=found, fix=fix) from error
    there = NEEDED & set(arrays)
    for key in sorted(there):
        if arrays[key].dtype.kind == "f" and not np.isfinite(arrays[key]).all():
            where = f"{episode.where}/{schema.EPISODE_FILE}, {key}"
            raise DatasetError("this array holds NaN or infinity", where=where, fix=_VALIDATE)
    missing, lengths = sorted(NEEDED - set(arrays)), {len(arrays[key]) for key in there if arrays[key].ndim}
    if missing or lengths != {episode.steps}:
        found = f"no {', '.join(missing)}" if missing else f"lengths {sorted(lengths)}"
        raise DatasetError("this episode is not complete", where=episode.where, found=found, fix=fix)
    return arrays


def open_player(request: Request) -> Player:
    """Open what is to be converted: a trajectory file, or a dataset of any format.

    Raises:
        DatasetError: it is neither, can't be read, or the options don't suit it.
    """
    return RecordingPlayer(request) if request.is_trajectory else DatasetPlayer(open_source(request.path), request)
