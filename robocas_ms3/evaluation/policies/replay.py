"""Policies that follow tracks of joint targets or TCP poses; `ReplayPolicy` replays recordings."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.demos.recordings.environment import read_recorded_env
from robocas_ms3.demos.recordings.motion import Motion, sample_states
from robocas_ms3.demos.recordings.trajectory_hdf5 import open_episode, open_trajectory, read_actions
from robocas_ms3.demos.recordings.trajectory_json import is_intervention, read_json, read_reset
from robocas_ms3.evaluation.policy import EpisodeSpec, Observations, PolicySpec
from robocas_ms3.robots.description import RobotDescription
from robocas_ms3.robots.registry import RobotSpec

Array = NDArray[np.floating]


@dataclass
class JointTrack:
    """A track of joint targets (S, 8); the last target is held. With S = 0 the arm does not move."""

    actions: Array
    step: int = 0

    def next_action(self, observations: Observations, row: int) -> Array:
        """Return the next action (8,) for the env of a row."""
        if not len(self.actions):
            self.actions = np.append(observations.qpos[row, RobotDescription.arm_slice], 1.0)[None]
        action = self.actions[min(self.step, len(self.actions) - 1)]
        self.step += 1
        return action


@dataclass
class PoseTrack:
    """A track of TCP poses, one per policy step; each action moves from the present to the next pose.

    Attributes:
        poses: (S, 4, 4) in the frame of the arm's base; with S = 0 the arm does not move.
        open: (S,) bool, gripper commands.
    """

    poses: Array
    open: NDArray[np.bool_]
    step: int = 0

    @classmethod
    def from_recording(cls, robot: RobotSpec, robot_states: Array, gripper: Array, stride: int) -> PoseTrack:
        """Return the track of a recording with one pose per ``stride`` control steps.

        Args:
            robot: the robot.
            robot_states: (S + 1, 37) after the reset and after each control step.
            gripper: (S,) commands in [-1, 1].
            stride: control steps per pose.
        """
        if not len(gripper):
            return cls(np.zeros((0, 4, 4)), np.zeros(0, dtype=bool))
        motion = Motion.from_states(robot, robot_states, gripper, sample_states(len(gripper), stride))
        return cls(motion.tcp_in_base[1:], motion.gripper_open[1:])

    def next_action(self, observations: Observations, row: int) -> Array:
        """Return the next action (7,) for the env of a row, in the convention ``robocas``."""
        place = min(self.step, len(self.poses) - 1)
        self.step += 1
        if place < 0:
            return np.array([0, 0, 0, 0, 0, 0, 1.0])
        tcp = observations.tcp_in_base[row].astype(np.float64)
        turn = Rotation.from_quat(tcp[[4, 5, 6, 3]]).inv()
        motion = turn.apply(self.poses[place, :3, 3] - tcp[:3])
        angles = (turn * Rotation.from_matrix(self.poses[place, :3, :3])).as_euler("xyz")
        return np.array([*motion, *angles, float(self.open[place])])


class TrackPolicy(ABC):
    """Base class of policies that follow one track per episode."""

    def __init__(self) -> None:
        self._tracks: dict[int, JointTrack | PoseTrack] = {}  # by env

    @abstractmethod
    def make_track(self, episode: EpisodeSpec) -> JointTrack | PoseTrack:
        """Return the track of an episode."""

    def reset(self, episodes: list[EpisodeSpec]) -> None:
        self._tracks |= {episode.env: self.make_track(episode) for episode in episodes}

    def act(self, observations: Observations) -> Array:
        """Return (E, A) actions."""
        envs = observations.envs.tolist()
        return np.stack([self._tracks[env].next_action(observations, row) for row, env in enumerate(envs)])


class ReplayPolicy(TrackPolicy):
    """Policy that replays the actions of a trajectory file at its rate; it does not move for other seeds.

    Args:
        trajectory: HDF5 file of joint targets (``pd_joint_pos``) with a JSON file of the same name.
    """

    def __init__(self, trajectory: Path) -> None:
        super().__init__()
        self._trajectory = trajectory = trajectory.absolute()
        data = read_json(trajectory)
        env = read_recorded_env(data["env_info"], trajectory.with_suffix(".json"))
        if env.control_mode != "pd_joint_pos":
            what, found = "cannot replay actions of this control mode", env.control_mode
            raise EvaluationError(what, where=trajectory, expected="pd_joint_pos", found=found)
        if any(map(is_intervention, data["episodes"])):
            what, fix = (
                "cannot replay expert interventions, which start in a state of another policy",
                "Use robocas replay.",
            )
            raise EvaluationError(what, where=trajectory, expected="episodes that start with a reset", fix=fix)
        self._episodes = {
            read_reset(one, f"{trajectory}, traj_{one['episode_id']}")[0]: one["episode_id"] for one in data["episodes"]
        }
        rate = env.kwargs.get("sim_config", {}).get("control_freq", 20)
        self.spec = PolicySpec(convention="joint_positions", rate_hz=rate, language="none")

    def describe(self) -> dict[str, Any]:
        return {"trajectory": self._trajectory.name, "episodes": len(self._episodes)}

    def make_track(self, episode: EpisodeSpec) -> JointTrack:
        if episode.seed not in self._episodes:
            return JointTrack(np.zeros((0, 8)))
        number = self._episodes[episode.seed]
        with open_trajectory(self._trajectory) as file:
            actions = read_actions(open_episode(file, number))
        if (found := actions.shape[1]) != 8:
            where, expected = f"{self._trajectory}, traj_{number}", "8 numbers per action"
            raise EvaluationError("cannot replay actions of this size", where=where, expected=expected, found=found)
        return JointTrack(actions)
