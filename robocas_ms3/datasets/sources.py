"""Where training samples come from: a RoboCAS folder, or a trajectory file, which holds no pictures.

A source reads an overview when it is made and everything else when it is asked for; it keeps no file open, so it may
be pickled and forked.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, Protocol

import h5py
import numpy as np
from numpy.typing import NDArray

from robocas_ms3.datasets import schema
from robocas_ms3.datasets.episode import SubGoal, episode_arrays, sample_subgoals
from robocas_ms3.datasets.info import action_space, split_by_seed
from robocas_ms3.datasets.provenance import succeeded
from robocas_ms3.datasets.reader import Dataset, Episode
from robocas_ms3.datasets.tolerant import DAMAGED
from robocas_ms3.datasets.trajectory import Recording, TrajectoryFile
from robocas_ms3.demos.sampling import gripper_open, sample_states, sample_stride
from robocas_ms3.errors import DatasetError
from robocas_ms3.robots.constants import OPEN_FINGER, ROBOT_UID

Split = Literal["train", "val", "all"]
FINGER_RANGE = (-0.01, OPEN_FINGER)
"""Target of one finger at the gripper actions -1 and +1, as the robot's controller has it, m."""


class Source(Protocol):
    """Episodes by number.

    Attributes:
        path: the folder or file.
        rate_hz: steps a second.
        lengths: number -> T.
        cameras: that there are pictures of.
        has_depth: whether depth is there.
        has_embeddings: of texts.
    """

    path: Path
    rate_hz: float
    lengths: dict[int, int]
    cameras: tuple[str, ...]
    has_depth: bool
    has_embeddings: bool

    def split(self, side: Split) -> list[int]:
        """Numbers of the episodes of one side."""
        ...

    def goals(self, number: int) -> list[SubGoal]:
        """Sub-goals of an episode; empty where they are not known."""
        ...

    def arrays(self, number: int, keys: Sequence[str]) -> dict[str, NDArray]:
        """Some of an episode's arrays, by the schema's keys."""
        ...

    def action_space(self) -> dict[str, Any]:
        """As in ``data_info.json``."""
        ...

    def episode(self, number: int) -> Episode:
        """An episode's pictures."""
        ...


def open_source(path: Path | str, *, rate_hz: float | None = None, include_failed: bool = False) -> Source:
    """Open a RoboCAS folder or a trajectory file.

    Args:
        path: of it; a file is taken for a trajectory.
        rate_hz: steps a second, for trajectories (default 5); a folder has its own.
        include_failed: for trajectories: also episodes without success.

    Raises:
        DatasetError: it can't be read, or the folder is of another rate.
    """
    path = Path(path)
    if path.is_file() or path.suffix in {".h5", ".hdf5"}:
        return TrajectorySource(path, rate_hz=rate_hz or 5.0, include_failed=include_failed)
    source = FolderSource(path)
    if rate_hz is not None and rate_hz != source.rate_hz:
        raise DatasetError(
            "the dataset has another rate",
            where=path,
            expected=f"{source.rate_hz:g} Hz",
            found=f"{rate_hz:g}",
            fix="Convert the trajectory again with this --rate.",
        )
    return source


class FolderSource:
    """A RoboCAS folder. Reads ``data_info.json`` and ``conversion.json``.

    Raises:
        DatasetError: one of them is missing or damaged.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        info_file = path / schema.DATA_INFO_FILE
        if not info_file.is_file():
            raise DatasetError(
                "no dataset here",
                where=path,
                expected=f"a folder with {schema.DATA_INFO_FILE}, or a trajectory.h5",
                fix="Make one with robocas convert.",
            )
        overview = _Overview(path)
        self.info, settings = overview.info, overview.settings
        try:
            self.lengths = {int(number): int(length) for number, length in self.info["ep_length"].items()}
            self._split = {side: [int(n) for n in self.info[f"{side}_eps"]] for side in ("train", "val")}
            self.rate_hz = overview.rate_hz
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise DatasetError(
                "this overview is damaged",
                where=info_file,
                expected="ep_length, train_eps, val_eps",
                found=f"{type(error).__name__}: {error}",
                fix="robocas validate says what is wrong.",
            ) from error
        first = Episode(path / schema.episode_folder(min(self.lengths, default=0)))  # where there are no settings
        self.cameras = tuple(settings["cameras"]) if "cameras" in settings else first.cameras
        self.has_depth = bool(settings["depth"]) if "depth" in settings else first.has_depth
        self.has_embeddings = bool(settings.get("embeddings", True))

    def split(self, side: Split) -> list[int]:
        """Numbers of the episodes of one side.

        Raises:
            DatasetError: ``data_info.json`` gives no length for one of them.
        """
        numbers = sorted(self.lengths) if side == "all" else self._split[side]
        unknown = [number for number in numbers if number not in self.lengths]
        if unknown:
            raise DatasetError("episodes of unknown length", where=self.path / schema.DATA_INFO_FILE, found=unknown[:5])
        return numbers

    def goals(self, number: int) -> list[SubGoal]:
        """Sub-goals of an episode, from ``data_info.json``."""
        entries = self.info.get("step_goals", {}).get(str(number), [])
        try:
            return [SubGoal(e["goal_type"], e["goal_description"], *map(int, e["goal_range"])) for e in entries]
        except (KeyError, TypeError, ValueError) as error:
            raise DatasetError(
                "these sub-goals are damaged",
                where=f"{self.path / schema.DATA_INFO_FILE}, step_goals.{number}",
                expected="goal_type, goal_range [first, last], goal_description",
                found=str(entries)[:80],
            ) from error

    def arrays(self, number: int, keys: Sequence[str]) -> dict[str, NDArray]:
        """Read some of an episode's arrays.

        Raises:
            DatasetError: the file or one of them is missing or damaged.
        """
        path = self.path / schema.episode_folder(number) / schema.EPISODE_FILE
        try:
            with np.load(path, allow_pickle=False) as content:
                found = {key: content[key] for key in keys if key in content.files}
            if all(key in found and _is_declared(key, found[key]) for key in keys):
                return found
            made = self._dataset.episode(number).arrays  # slower; casts and completes what was made elsewhere
        except (*DAMAGED, KeyError) as error:
            raise DatasetError(
                "this episode can't be read",
                where=path,
                found=getattr(error, "strerror", None) or str(error).splitlines()[0],
                fix="robocas validate says what is wrong.",
            ) from error
        missing = [key for key in keys if key not in made]
        if missing:
            raise DatasetError("arrays are missing", where=path, expected=", ".join(missing))
        return {key: made[key] for key in keys}

    @cached_property
    def _dataset(self) -> Dataset:
        return Dataset(self.path)

    def action_space(self) -> dict[str, Any]:
        """As ``data_info.json`` has it."""
        return self.info.get("action_space", {})

    def episode(self, number: int) -> Episode:
        """An episode's folder, which is not looked at yet."""
        return Episode(self.path / schema.episode_folder(number))


_SPECS = {spec.name: spec for spec in schema.EPISODE_INFO}


def _is_declared(key: str, array: NDArray) -> bool:
    """Whether an array has the schema's type and number of axes."""
    return _SPECS[key].has_dtype(array) and array.ndim == len(_SPECS[key].shape)


class _Overview(Dataset):
    """A dataset's overview alone: the folder is not listed."""

    def __post_init__(self) -> None:
        """Nothing to check."""


@dataclass(frozen=True)
class _Entry:
    """What the JSON says of a recorded episode."""

    name: str
    control_steps: int
    control_mode: str
    instruction: str
    subgoals: list[SubGoal]


class TrajectorySource:
    """A trajectory file of ``robocas generate``: its episodes as ``robocas convert`` would number and sample them.

    Raises:
        DatasetError: it can't be read, holds no (successful) episode, or the rate does not divide its frequency.
    """

    cameras: tuple[str, ...] = ()
    has_depth = False
    has_embeddings = False

    def __init__(self, path: Path, *, rate_hz: float = 5.0, include_failed: bool = False) -> None:
        self.path, self.rate_hz = path, rate_hz
        with TrajectoryFile(path) as file:
            self._stride = sample_stride(file.control_freq, rate_hz)
            chosen = [episode for episode in file.episodes if include_failed or succeeded(episode)]
            try:
                self._entries = [_entry(episode) for episode in chosen]
                seeds = {n: int(np.ravel(episode["episode_seed"])[0]) for n, episode in enumerate(chosen)}
            except (KeyError, TypeError, ValueError, IndexError) as error:
                raise DatasetError(
                    "the JSON's entries are incomplete",
                    where=path.with_suffix(".json"),
                    found=f"{type(error).__name__}: {error}",
                ) from error
        self.lengths = {n: len(sample_states(e.control_steps, self._stride)) for n, e in enumerate(self._entries)}
        train, val = split_by_seed(seeds)
        self._split = {"train": train, "val": val, "all": list(self.lengths)}

    def split(self, side: Split) -> list[int]:
        """Numbers of the episodes of one side, by the rule of ``robocas convert``."""
        return self._split[side]

    def goals(self, number: int) -> list[SubGoal]:
        """Sub-goals of an episode, over the sampled steps."""
        entry = self._entries[number]
        return sample_subgoals(entry.subgoals, sample_states(entry.control_steps, self._stride))

    def arrays(self, number: int, keys: Sequence[str]) -> dict[str, NDArray]:
        """Compute an episode's arrays from its states, by forward kinematics.

        Raises:
            DatasetError: it is damaged, or the states are those of another robot.
        """
        from robocas_ms3.datasets.forward import robot_frames

        entry = self._entries[number]
        recording = self._read(entry)
        samples = sample_states(entry.control_steps, self._stride)
        joints = recording.joints(samples)
        status = gripper_open(
            recording.actions[:, 6 if "_ee_" in entry.control_mode else 7],
            samples,
            finger_range=FINGER_RANGE,
            initial_width=float(joints.qpos[0, 10:12].sum()),
        )
        made = episode_arrays(robot_frames(joints), joints, status, entry.instruction, self.goals(number))
        missing = [key for key in keys if key not in made]
        if missing:
            raise DatasetError("a trajectory file does not hold this", where=self.path, found=", ".join(missing))
        return {key: made[key] for key in keys}

    def _read(self, entry: _Entry) -> Recording:
        try:
            with h5py.File(self.path, "r") as file:
                group: Any = file[entry.name]
                actions = np.asarray(group["actions"], dtype=np.float32)
                robot = np.asarray(group["env_states"]["articulations"][ROBOT_UID], dtype=np.float32)
        except (OSError, KeyError, RuntimeError) as error:
            raise DatasetError(
                "this episode is damaged", where=f"{self.path}, {entry.name}", found=str(error).splitlines()[0]
            ) from error
        if len(actions) != entry.control_steps or len(robot) != len(actions) + 1:
            raise DatasetError(
                "actions, states and JSON differ in length",
                where=f"{self.path}, {entry.name}",
                expected=f"{entry.control_steps} actions, one state more",
                found=f"{len(actions)} actions, {len(robot)} states",
            )
        states = {"articulations": {ROBOT_UID: robot}}
        return Recording(0, 0, {}, entry.control_mode, entry.instruction, entry.subgoals, actions, states)

    def action_space(self) -> dict[str, Any]:
        """Percentiles over all episodes, which are read for it."""
        parts = [self.arrays(number, ("rel_pos", "rel_orn")) for number in self.lengths]
        return action_space([part["rel_pos"] for part in parts], [part["rel_orn"] for part in parts])

    def episode(self, number: int) -> Episode:
        """Not here.

        Raises:
            DatasetError: always.
        """
        raise DatasetError(
            "a trajectory file holds no pictures", where=self.path, fix="Convert it with robocas convert."
        )


def _entry(episode: dict[str, Any]) -> _Entry:
    said = episode["robocas"]
    goals = [SubGoal(g["goal_type"], g["goal_description"], *map(int, g["goal_range"])) for g in said["subgoals"]]
    steps = int(episode["elapsed_steps"] if "elapsed_steps" in episode else goals[-1].last + 1)
    return _Entry(f"traj_{episode['episode_id']}", steps, episode["control_mode"], said["instruction"], goals)
