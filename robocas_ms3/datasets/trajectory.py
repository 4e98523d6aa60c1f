"""Reads a ManiSkill trajectory, ``F.h5`` with ``F.json`` beside it, as the generator writes it."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from robocas_ms3.datasets.episode import Joints, SubGoal
from robocas_ms3.demos.sampling import split_states
from robocas_ms3.errors import DatasetError
from robocas_ms3.robots.constants import JOINTS, ROBOT_UID

_STATE_DIM = 13 + 2 * len(JOINTS)


@dataclass(frozen=True)
class Recording:
    """One recorded episode of S control steps.

    Attributes:
        episode_id: number in the trajectory file.
        seed: the environment's seed, which builds its scene.
        reset_options: further arguments of ``env.reset``.
        control_mode: of the actions.
        instruction: what the robot was told.
        subgoals: ranges over the actions 0..S-1.
        actions: (S, A).
        states: ``{"actors": {name: (S+1, 13)}, "articulations": {name: (S+1, 13 + 2 joints)}}``.
    """

    episode_id: int
    seed: int
    reset_options: dict[str, Any]
    control_mode: str
    instruction: str
    subgoals: list[SubGoal]
    actions: NDArray[np.float32]
    states: dict[str, dict[str, NDArray[np.float32]]]

    @property
    def control_steps(self) -> int:
        """S."""
        return len(self.actions)

    def joints(self, samples: NDArray[np.int64]) -> Joints:
        """Joint states at some of the states."""
        root_in_world, qpos, qvel = split_states(self.states["articulations"][ROBOT_UID][samples])
        return Joints(qpos, qvel, root_in_world)

    def state(self, index: int) -> dict[str, dict[str, NDArray[np.float32]]]:
        """One state as ``set_state_dict`` takes it, each array (1, D)."""
        return {kind: {n: a[index : index + 1] for n, a in arrays.items()} for kind, arrays in self.states.items()}


class TrajectoryFile:
    """An open trajectory; use it in a ``with`` statement.

    Attributes:
        path: the HDF5 file.
        env_info: ``env_id``, ``env_kwargs``, ... of the JSON.
        control_freq: Hz.
        versions: what it was made with.
        episodes: the JSON's entries.
    """

    def __init__(self, path: str | Path) -> None:
        """Open both files and check that they belong together.

        Raises:
            DatasetError: a file is missing, damaged, or they do not match.
        """
        self.path = Path(path)
        metadata_path = self.path.with_suffix(".json")
        if self.path.is_dir():
            inside = self.path / "trajectory.h5"
            fix = f"Did you mean {inside}?" if inside.is_file() else "Give the .h5 file that robocas generate made."
            raise DatasetError("this is a folder, not a trajectory file", where=self.path, fix=fix)
        if not self.path.is_file():
            raise DatasetError("no such trajectory file", where=self.path, fix="Make one with robocas generate.")
        if not metadata_path.is_file():
            raise DatasetError("the JSON that belongs to this trajectory is missing", where=metadata_path)
        try:
            metadata = json.loads(metadata_path.read_text(encoding="utf-8"))
            self.env_info: dict[str, Any] = metadata["env_info"]
            self.episodes: list[dict[str, Any]] = metadata["episodes"]
            missing = {"env_id", "env_kwargs"} - set(self.env_info)
            if missing:
                raise KeyError(*sorted(missing))
        except (ValueError, KeyError, TypeError) as error:
            raise DatasetError(
                "not a trajectory's JSON", where=metadata_path, expected="env_info and episodes", found=_reason(error)
            ) from error
        if "robocas" not in metadata:
            raise DatasetError(
                "the JSON lacks the instructions and sub-goals",
                where=metadata_path,
                expected="key 'robocas'",
                fix="Convert the file written by robocas generate; replays of it drop them.",
            )
        self.control_freq = float(metadata["robocas"].get("control_freq", 20))
        self.versions: dict[str, Any] = metadata["robocas"].get("versions", {})
        try:
            self._file = h5py.File(self.path, "r")
        except OSError as error:
            raise DatasetError(
                "can't read this HDF5 file: it is cut off, damaged, or no HDF5",
                where=self.path,
                found=_reason(error),
                fix="Generate it again.",
            ) from error
        listed, stored = {f"traj_{episode['episode_id']}" for episode in self.episodes}, set(self._file)
        if listed != stored:
            self.close()
            raise DatasetError(
                "HDF5 and JSON do not list the same episodes",
                where=self.path,
                expected=f"{len(listed)} of the JSON",
                found=f"{len(stored)}, {len(listed ^ stored)} of them differ",
            )

    def __enter__(self) -> TrajectoryFile:
        """Itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the file."""
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def recording(self, index: int) -> Recording:
        """Read an episode whole.

        Args:
            index: position in ``episodes``.

        Raises:
            DatasetError: it is damaged, or contradicts the JSON.
        """
        episode = self.episodes[index]
        name = f"traj_{episode['episode_id']}"
        where = f"{self.path}, {name}"
        try:
            group: Any = self._file[name]
            actions = np.asarray(group["actions"], dtype=np.float32)
            states = {
                kind: {key: np.asarray(data, dtype=np.float32) for key, data in group["env_states"][kind].items()}
                for kind in ("actors", "articulations")
                if kind in group["env_states"]
            }
        except (OSError, KeyError, RuntimeError, AttributeError) as error:
            raise DatasetError("this episode is damaged", where=where, found=_reason(error)) from error
        if len(actions) == 0:
            raise DatasetError("this episode has no actions", where=where)
        lengths = {len(array) for arrays in states.values() for array in arrays.values()}
        if lengths != {len(actions) + 1} or episode.get("elapsed_steps", len(actions)) != len(actions):
            raise DatasetError(
                "actions, states and JSON differ in length",
                where=where,
                expected=f"{episode.get('elapsed_steps', len(actions))} actions, one state more",
                found=f"{len(actions)} actions, {sorted(lengths)} states",
            )
        robot = states.get("articulations", {}).get(ROBOT_UID)
        width = _STATE_DIM
        if robot is None or robot.shape[1] != width:
            raise DatasetError(
                "states of another robot",
                where=where,
                expected=f"{ROBOT_UID} of {width} numbers",
                found=sorted(states.get("articulations", {})) if robot is None else robot.shape[1],
            )
        try:
            task = episode["robocas"]
            return Recording(
                episode_id=episode["episode_id"],
                seed=int(np.ravel(episode["episode_seed"])[0]),
                reset_options=episode.get("reset_kwargs", {}).get("options") or {},
                control_mode=episode["control_mode"],
                instruction=task["instruction"],
                subgoals=[
                    SubGoal(goal["goal_type"], goal["goal_description"], *map(int, goal["goal_range"]))
                    for goal in task["subgoals"]
                ],
                actions=actions,
                states=states,
            )
        except (KeyError, TypeError, IndexError) as error:
            raise DatasetError("the JSON's entry is incomplete", where=where, found=_reason(error)) from error


def _reason(error: Exception) -> str:
    text = str(error).strip() or type(error).__name__
    return f"no key {text}" if isinstance(error, KeyError) else text.splitlines()[0]
