"""Read a ManiSkill trajectory written by `robocas generate`: ``F.h5`` with ``F.json`` next to it."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.demos.recordings.environment import read_recorded_env
from robocas_ms3.demos.recordings.motion import Motion, select_gripper_commands
from robocas_ms3.demos.recordings.trajectory_hdf5 import (
    convert_read_errors,
    open_episode,
    open_trajectory,
    read_joint_deviations,
    read_steps,
)
from robocas_ms3.demos.recordings.trajectory_json import EpisodeEntry, RunRecord, read_entry, read_json
from robocas_ms3.robots.description import RobotDescription
from robocas_ms3.robots.registry import RobotSpec

_STATE_DIM = 13 + 2 * RobotDescription.finger_slice.stop


@dataclass(frozen=True)
class Recording(EpisodeEntry):
    """Recorded episode of S control steps: its JSON entry, actions and states.

    Attributes:
        actions: (S, A) executed actions in the control mode of the recording.
        states: states after the reset and after each control step, in ManiSkill's format:
            ``{"actors": {name: (S + 1, 13)}, "articulations": {name: (S + 1, 13 + 2 joints)}}``.
        robot: specification of the robot.
        joint_deviations: (S, 7) deviations of the arm joints that action noise has caused at the end of each control
            step, rad; None without noise.
    """

    actions: NDArray[np.float32]
    states: dict[str, dict[str, NDArray[np.float32]]]
    robot: RobotSpec
    joint_deviations: NDArray[np.float32] | None = None

    def compute_motion(self, samples: NDArray[np.int64]) -> Motion:
        """Compute the motion of the robot at sampled states (T,), given by their indices."""
        commands = select_gripper_commands(self.actions, self.control_mode)
        states = self.states["articulations"][self.robot.description.uid]
        return Motion.from_states(self.robot, states, commands, samples, self.joint_deviations)

    def state(self, index: int) -> dict[str, dict[str, NDArray[np.float32]]]:
        """Return the state with an index, 0 to S, as an argument of ``set_state_dict``; each array is (1, D)."""
        return {kind: {n: a[index : index + 1] for n, a in arrays.items()} for kind, arrays in self.states.items()}


class TrajectoryFile:
    """Trajectory file of `robocas generate`, open for reading; a context manager.

    Args:
        path: the .h5 file; the .json file with the same name is read too.
        pack: object pack to use instead of the recorded pack, by name or folder.

    Attributes:
        env_info: value of the key ``env_info`` of the JSON file: ``env_id``, ``env_kwargs``, ...
        env: specification of the recorded environment.
        robot: specification of the robot.
        control_freq: control rate of the recording, Hz.
        versions: package versions at the time of recording.
        episodes: episode entries of the JSON file.

    Raises:
        DatasetError: a file is missing, damaged, or not a trajectory file of `robocas generate`.
    """

    def __init__(self, path: str | Path, *, pack: str | Path | None = None) -> None:
        self.path = Path(path)
        metadata_path = self.path.with_suffix(".json")
        if self.path.is_dir():
            inside = self.path / "trajectory.h5"
            fix = f"Did you mean {inside}?" if inside.is_file() else "Pass the .h5 file of robocas generate."
            raise DatasetError("not a file", where=self.path, expected="an .h5 file", found="a folder", fix=fix)
        if not self.path.is_file():
            raise DatasetError("no such trajectory file", where=self.path, fix="Record one with robocas generate.")
        with open_trajectory(self.path):  # a damaged file is reported before a missing JSON file
            pass
        metadata = read_json(self.path)
        self.env_info: dict[str, Any] = metadata["env_info"]
        self.episodes: list[dict[str, Any]] = metadata["episodes"]
        self.env = read_recorded_env(self.env_info, metadata_path, pack=pack)
        self.robot = self.env.robot(f"{metadata_path}, env_info.env_kwargs.robot_uids")
        run = metadata.get("robocas")
        if run is None:
            raise DatasetError(
                "missing instructions and sub-goals",
                where=metadata_path,
                expected="key 'robocas'",
                fix="Use the file of robocas generate; replayed files do not have them.",
            )
        self.control_freq = float(run.get("control_freq", RunRecord().control_freq))
        self.versions: dict[str, Any] = run.get("versions", {})
        self._file = open_trajectory(self.path)
        listed = {f"traj_{episode['episode_id']}" for episode in self.episodes}
        with convert_read_errors(self.path, "damaged file"):
            stored = set(self._file)
        if listed != stored:
            self.close()
            raise DatasetError(
                "HDF5 and JSON contain different episodes",
                where=self.path,
                expected=f"the {len(listed)} episodes of the JSON in the HDF5 file",
                found=f"{len(stored)} episodes, {len(listed ^ stored)} differ",
                fix="Copy both files again, or record them again.",
            )

    def __enter__(self) -> TrajectoryFile:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._file.close()

    def reopen(self) -> TrajectoryFile:
        """Return a second open `TrajectoryFile` of the same file; the JSON file is not read again."""
        file = copy(self)
        file._file = open_trajectory(self.path)
        return file

    def __getstate__(self) -> dict[str, Any]:
        """Return the attributes to pickle, without the open HDF5 file."""
        return {**self.__dict__, "_file": None}

    def read_entry(self, index: int) -> EpisodeEntry:
        """Read the JSON entry of the episode at a position in ``episodes``, without actions and states."""
        return read_entry(self.episodes[index], self._where(index))

    def read_recording(self, index: int, *, bodies: bool = True) -> Recording:
        """Read the episode at a position in ``episodes``.

        Without ``bodies`` only the states of the robot are read.
        """
        where, uid = self._where(index), self.robot.description.uid
        group = open_episode(self._file, self.episodes[index]["episode_id"])
        actions, found = read_steps(group, body=None if bodies else uid)
        states = {
            kind: {name: rows.astype(np.float32, copy=False) for name, rows in of.items()} for kind, of in found.items()
        }
        entry = self.read_entry(index)
        if entry.control_steps != len(actions):
            expected = f"{entry.control_steps} actions as in the JSON"
            raise DatasetError("damaged episode", where=where, expected=expected, found=f"{len(actions)} actions")
        robot = states.get("articulations", {}).get(uid)
        width = _STATE_DIM
        if robot is None or robot.shape[1] != width:
            raise DatasetError(
                "states do not fit the robot",
                where=where,
                expected=f"{uid} with {width} numbers per state",
                found=sorted(states.get("articulations", {})) if robot is None else f"{robot.shape[1]} numbers",
            )
        deviations = read_joint_deviations(group, len(actions)) if entry.has_action_noise else None
        return Recording(**vars(entry), actions=actions, states=states, robot=self.robot, joint_deviations=deviations)

    def _where(self, index: int) -> str:
        return f"{self.path}, traj_{self.episodes[index]['episode_id']}"
