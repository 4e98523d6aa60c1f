"""Training samples of a trajectory file, which holds no pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np
from numpy.typing import NDArray

from robocas_ms3.datasets.episode import SubGoal, episode_arrays, robot_frames, sample_subgoals
from robocas_ms3.datasets.info import action_space, split_by_seed
from robocas_ms3.datasets.provenance import succeeded
from robocas_ms3.datasets.reader import Episode
from robocas_ms3.datasets.trajectory import Recording, TrajectoryFile
from robocas_ms3.demos.sampling import gripper_open, sample_states, sample_stride
from robocas_ms3.errors import DatasetError
from robocas_ms3.robots.constants import FINGER_TARGETS, ROBOT_UID

if TYPE_CHECKING:
    from robocas_ms3.datasets.sources import Split


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
        entry = self._entries[number]
        recording = self._read(entry)
        samples = sample_states(entry.control_steps, self._stride)
        joints = recording.joints(samples)
        status = gripper_open(
            recording.actions[:, 6 if "_ee_" in entry.control_mode else 7],
            samples,
            finger_range=FINGER_TARGETS,
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
