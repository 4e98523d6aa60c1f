"""Where episodes come from: a trajectory, which is rendered, or a RoboCAS dataset, whose pictures are read."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from numpy.typing import NDArray

from robocas_ms3.datasets import schema
from robocas_ms3.datasets.convert import choose
from robocas_ms3.datasets.lerobot.schema import needed_arrays, whole_rate
from robocas_ms3.datasets.pictures import Pictures
from robocas_ms3.datasets.provenance import fingerprint, scene_record, succeeded
from robocas_ms3.datasets.reader import Dataset, Episode
from robocas_ms3.datasets.tolerant import DAMAGED
from robocas_ms3.datasets.trajectory import TrajectoryFile
from robocas_ms3.datasets.workers import OpenSource
from robocas_ms3.datasets.writer import CameraModel, FrameSource, Shown, Timing, show_episode
from robocas_ms3.demos.sampling import sample_stride
from robocas_ms3.errors import DatasetError

DEFAULT_RATE = 5.0

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
    """

    path: Path
    rate_hz: float | None
    pictures: Pictures
    include_failed: bool
    open_source: OpenSource


class EpisodeSource(Protocol):
    """Gives episodes, one at a time."""

    fps: int
    cameras: tuple[str, ...]
    depth: bool
    size: tuple[int, int] | None

    def entries(self) -> list[dict[str, Any]]:
        """Of each episode, in order, what tells it from others; ``source`` is its number for `play`."""
        ...

    def play(self, number: int, on_frame: OnFrame, timing: Timing) -> Shown:
        """Hand over an episode's pictures, then the rest."""
        ...

    def close(self) -> None:
        """Free what it holds."""
        ...


def open_request(request: Request) -> EpisodeSource:
    """Open what is to be converted.

    Raises:
        DatasetError: it is neither, can't be read, or the options don't suit it.
    """
    return FolderSource(request) if request.path.is_dir() else TrajectorySource(request)


class TrajectorySource:
    """Renders the recordings of a trajectory."""

    def __init__(self, request: Request) -> None:
        """Open the file; the environment is made with the first episode.

        Raises:
            DatasetError: the file is unusable, or the rate does not suit it.
        """
        self._request = request
        self._rate = DEFAULT_RATE if request.rate_hz is None else request.rate_hz
        self._file = TrajectoryFile(request.path)
        try:
            self.fps = whole_rate(self._rate)
            self._stride = sample_stride(self._file.control_freq, self._rate)
        except DatasetError:
            self._file.close()
            raise
        self.cameras, self.depth = request.pictures.cameras, request.pictures.depth
        self.size = request.pictures.size
        self._source: FrameSource | None = None
        self._control_mode = ""

    def entries(self) -> list[dict[str, Any]]:
        """The episodes that are wanted."""
        found = []
        for index in choose(self._file, self._request.include_failed):
            episode = self._file.episodes[index]
            entry = {
                "source": index,
                "trajectory": self._file.path.name,
                "trajectory_episode": episode["episode_id"],
                "seed": episode.get("episode_seed"),
                "success": succeeded(episode),
                "target": episode.get("robocas", {}).get("target"),
                "recording": fingerprint(self._file.recording(index)),
            }
            found.append(entry)
        return found

    def play(self, number: int, on_frame: OnFrame, timing: Timing) -> Shown:
        """Render the recording of this index."""
        recording = self._file.recording(number)
        if self._source is None or recording.control_mode != self._control_mode:
            self._close_source()
            request = self._request
            self._source = request.open_source(self._file.env_info, recording.control_mode, request.pictures)
            self._control_mode = recording.control_mode
        shown = show_episode(
            recording,
            self._source,
            stride=self._stride,
            embed=None,
            on_frame=lambda step, frame: on_frame(step, frame.rgb, frame.depth),
            timing=timing,
        )
        scene = scene_record(self._file, number, recording, shown.scene, self._rate)
        return Shown(shown.arrays, shown.cameras, scene)

    def close(self) -> None:
        """Close environment and file."""
        self._close_source()
        self._file.close()

    def _close_source(self) -> None:
        if self._source is not None:
            self._source.close()
            self._source = None


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
        height, width = first.rgb(self.cameras[0], 0).shape[:2]
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

    def play(self, number: int, on_frame: OnFrame, timing: Timing) -> Shown:
        """Read the episode of this number."""
        episode = self._dataset.episode(number)
        arrays = _arrays(episode)
        for step in range(episode.steps):
            begun = time.perf_counter()
            rgb = {camera: episode.rgb(camera, step) for camera in self.cameras}
            depth = {camera: episode.depth(camera, step) for camera in self.cameras} if self.depth else {}
            timing.load += time.perf_counter() - begun
            on_frame(step, rgb, depth)
        cameras = {name: CameraModel(episode.intrinsic(name), episode.camera_in_parent(name)) for name in self.cameras}
        return Shown(arrays, cameras, episode.scene)

    def close(self) -> None:
        """Nothing is open."""


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
    if missing or lengths != {episode.steps}:
        raise DatasetError(
            "this episode is not complete",
            where=episode.folder / schema.EPISODE_FILE,
            found=f"no {', '.join(missing)}" if missing else f"lengths {sorted(lengths)}",
            fix="robocas validate says what is wrong.",
        )
    return arrays
