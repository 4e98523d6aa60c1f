"""What writers write: episodes one at a time, with the frames of a recording that is rendered or of a dataset."""

from __future__ import annotations

import logging
import time
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from numpy.typing import NDArray

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.words import count_of
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.formats import format_of
from robocas_ms3.datasets.pictures.stored import Pictures
from robocas_ms3.datasets.sources.arrays import episode_arrays
from robocas_ms3.datasets.sources.episode import DEFAULT_RATE
from robocas_ms3.datasets.sources.provenance import recording_entry, scene_record, succeeded, unread_entry
from robocas_ms3.datasets.writing.frames import CameraModel, Frame, FrameSource, OpenSource
from robocas_ms3.datasets.writing.timing import Timing
from robocas_ms3.demos.recordings.environment import RecordedEnv
from robocas_ms3.demos.recordings.motion import sample_states, sample_stride
from robocas_ms3.demos.recordings.reading import Recording, TrajectoryFile
from robocas_ms3.demos.recordings.subgoals import sample_subgoals

_log = logging.getLogger(__name__)


def open_env(env: RecordedEnv, control_mode: str, pictures: Pictures) -> FrameSource:
    """Show states through the environment that recorded them."""
    from robocas_ms3.datasets.writing.render import EnvFrames

    return EnvFrames(env, control_mode, pictures)


@dataclass(frozen=True)
class Request:
    """What is to be converted; can be sent to another process.

    Attributes:
        path: ``F.h5``, or the folder of a dataset.
        rate_hz: steps a second; None: 5, or the dataset's.
        pictures: cameras, size and depth.
        include_failed: also episodes without success.
        open_source: makes what shows a trajectory's states.
        pack: of the objects, instead of what a trajectory names.
    """

    path: Path
    rate_hz: float | None
    pictures: Pictures
    include_failed: bool = False
    open_source: OpenSource = open_env
    pack: str | Path | None = None

    @property
    def is_trajectory(self) -> bool:
        """Whether its pictures have to be rendered."""
        found = format_of(self.path)
        return found.name == "trajectory" if found else not self.path.is_dir()

    @property
    def renders(self) -> bool:
        """Whether a renderer is needed."""
        return self.open_source is open_env and self.is_trajectory


class Played(Protocol):
    """An episode as writers take it: arrays first, then all frames in order, then the rest."""

    @property
    def arrays(self) -> dict[str, NDArray]:
        """All but the embeddings, by the schema's keys."""
        ...

    def frames(self) -> Generator[Frame, None, None]:
        """One a step; files may be open until it is closed."""
        ...

    def cameras(self) -> dict[str, CameraModel]:
        """By name; after the frames."""
        ...

    def scene(self) -> dict[str, Any]:
        """Content of ``scene.json``; after the frames."""
        ...


class Player(Protocol):
    """Gives episodes, one at a time, by ``source`` of their entries."""

    rate_hz: float
    pictures: Pictures

    def entries(self) -> list[dict[str, Any]]:
        """Of each episode, in order, which recording it is, and ``source``, its number for `open`."""
        ...

    def texts(self, number: int) -> list[str]:
        """Instruction and sub-goals of an episode."""
        ...

    def sides(self) -> tuple[list[int], list[int]]:
        """``source`` of the training and validation episodes, as far as that was settled before."""
        ...

    def open(self, number: int, timing: Timing) -> Played:
        """Open an episode; what it takes is added to the timing."""
        ...

    def close(self) -> None:
        """Free what it holds."""
        ...


class RecordingPlayer:
    """Renders the recordings of a trajectory file; its environment is made with the first episode.

    Raises:
        DatasetError: the file is unusable, or the rate does not suit it.
    """

    def __init__(self, request: Request) -> None:
        self.rate_hz = float(DEFAULT_RATE if request.rate_hz is None else request.rate_hz)
        self.pictures = request.pictures
        self._request = request
        self.file = TrajectoryFile(request.path, pack=request.pack)
        try:
            self._stride = sample_stride(self.file.control_freq, self.rate_hz)
        except DatasetError:
            self.file.close()
            raise
        self._shown: FrameSource | None = None
        self._control_mode = ""

    def turn_to(self, trajectory: Path) -> None:
        """Go on with another file, of the same environment, which stays.

        Raises:
            DatasetError: the file is unusable, or of another environment or control rate.
        """
        file = TrajectoryFile(trajectory, pack=self._request.pack)
        if (file.env, file.control_freq) != (self.file.env, self.file.control_freq):
            file.close()
            raise DatasetError("this file is of another environment", where=trajectory, expected=self.file.path)
        self.file.close()
        self.file = file

    def entries(self) -> list[dict[str, Any]]:
        """The episodes that are wanted; warns where their actions were tried at another rate.

        Raises:
            DatasetError: there are none.
        """
        chosen = _choose(self.file, self._request.include_failed)
        _warn_untried(self.file, chosen, self.rate_hz)
        entries = [{"source": index, **_entry(self.file, index)} for index in chosen]
        first = {entry["recording"]: entry for entry in reversed(entries)}
        once = [entry for entry in entries if entry["recording"] is None or first[entry["recording"]] is entry]
        if len(once) < len(entries):
            again = [str(entry["trajectory_episode"]) for entry in entries if entry not in once]
            _log.warning("%s: the same recordings again, left out: %s", self.file.path, ", ".join(again))
        return once

    def texts(self, number: int) -> list[str]:
        """Instruction and sub-goals."""
        entry = self.file.entry(number)
        return [entry.instruction, *(goal.goal_description for goal in entry.subgoals)]

    def sides(self) -> tuple[list[int], list[int]]:
        """None: a trajectory has no sides."""
        return [], []

    def open(self, number: int, timing: Timing) -> Played:
        """Build the scene of the recording of this index.

        Raises:
            DatasetError: it is damaged, too long for four digits, or its scene can't be built.
        """
        with timing.measure("load"):
            recording = self.file.recording(number)
            samples = sample_states(recording.control_steps, self._stride)
            if len(samples) > schema.MAX_STEPS:
                where = f"episode {recording.episode_id}"
                raise DatasetError("too many steps", where=where, expected=f"<= {schema.MAX_STEPS}", found=len(samples))
            if self._shown is None or recording.control_mode != self._control_mode:
                self._close_shown()
                self._shown = self._request.open_source(self.file.env, recording.control_mode, self.pictures)
                self._control_mode = recording.control_mode
            self._shown.load(recording)
        with timing.measure("write"):
            goals = sample_subgoals(recording.subgoals, samples)
            arrays = episode_arrays(recording.motion(samples), recording.instruction, goals)
        return _PlayedRecording(self, self._shown, recording, number, samples, arrays, timing)

    def close(self) -> None:
        """Close environment and file."""
        self._close_shown()
        self.file.close()

    def _close_shown(self) -> None:
        if self._shown is not None:
            self._shown.close()
            self._shown = None


@dataclass(frozen=True)
class _PlayedRecording:
    player: RecordingPlayer
    shown: FrameSource
    recording: Recording
    number: int
    samples: NDArray
    arrays: dict[str, NDArray]
    timing: Timing

    def frames(self) -> Generator[Frame, None, None]:
        begun = time.perf_counter()
        for frame in self.shown.frames(self.recording, self.samples):
            self.timing.render += time.perf_counter() - begun
            yield frame
            begun = time.perf_counter()

    def cameras(self) -> dict[str, CameraModel]:
        return self.shown.cameras()

    def scene(self) -> dict[str, Any]:
        file = self.player.file
        return scene_record(file, self.number, self.recording, self.shown.scene(), self.player.rate_hz)


def _entry(file: TrajectoryFile, index: int) -> dict[str, Any]:
    """Which recording it is; of one that can't be read, which is said when it is its turn, ``recording`` is None."""
    try:
        return recording_entry(file, index)
    except DatasetError:
        return unread_entry(file, index)


def _choose(file: TrajectoryFile, include_failed: bool) -> list[int]:
    chosen = [i for i, episode in enumerate(file.episodes) if include_failed or succeeded(episode)]
    if not chosen:
        some = bool(file.episodes)
        raise DatasetError(
            "no successful episodes to convert" if some else "no episodes to convert",
            where=file.path,
            found=count_of(len(file.episodes), "episode"),
            fix="Pass --include-failed to convert them all the same." if some else "",
        )
    return chosen


def _warn_untried(file: TrajectoryFile, chosen: list[int], rate_hz: float) -> None:
    """Say so where the recordings' actions were tried open loop, but at another rate than the dataset's."""
    entries = [file.episodes[index].get("robocas") for index in chosen]
    said = [entry.get("replay_rate") for entry in entries if isinstance(entry, dict)]
    tried = {float(rate) for rate in said if isinstance(rate, int | float) and rate}  # else not tried, or not known
    others = sorted(rate for rate in tried if abs(rate - rate_hz) > 1e-9)
    if others:
        _log.warning(
            "actions were tried at %s Hz; at %g Hz they were not: robocas validate --replay tells (of RoboCAS folders)",
            *(" and ".join(f"{rate:g}" for rate in others), rate_hz),
        )
