"""Policies that follow a track that was planned or recorded before: joint targets, or poses of the TCP."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocas_ms3.demos.recordings.motion import Motion, sample_states
from robocas_ms3.evaluation.policy import EpisodeSpec, Observations
from robocas_ms3.robots.description import RobotDescription
from robocas_ms3.robots.table import RobotSpec

Array = NDArray[np.floating]


@dataclass
class JointTrack:
    """Joint targets (S, 8), of which the last one is held; without any the arm stays where it is."""

    actions: Array
    step: int = 0

    def next(self, observations: Observations, row: int) -> Array:
        """Return the next action (8,) of a row's env."""
        if not len(self.actions):
            self.actions = np.append(observations.qpos[row, RobotDescription.arm_slice], 1.0)[None]
        action = self.actions[min(self.step, len(self.actions) - 1)]
        self.step += 1
        return action


@dataclass
class PoseTrack:
    """Poses of the TCP, one per policy step: each action leads there from where the TCP is by then.

    Attributes:
        poses: (S, 4, 4) in the arm's base frame; without any the arm stays where it is.
        open: (S,) bool, commands of the gripper.
    """

    poses: Array
    open: NDArray[np.bool_]
    step: int = 0

    @classmethod
    def of(cls, robot: RobotSpec, robot_states: Array, gripper: Array, stride: int) -> PoseTrack:
        """Return the track of a recording.

        Args:
            robot: that was recorded.
            robot_states: (S + 1, 37) after the reset and after each control step.
            gripper: (S,) commands in [-1, 1].
            stride: control steps per policy step.
        """
        if not len(gripper):
            return cls(np.zeros((0, 4, 4)), np.zeros(0, dtype=bool))
        motion = Motion.of(robot, robot_states, gripper, sample_states(len(gripper), stride))
        return cls(motion.tcp_in_base[1:], motion.gripper_open[1:])

    def next(self, observations: Observations, row: int) -> Array:
        """Return the next action (7,) of a row's env, in RoboCAS' convention."""
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
    """Follow a track in each episode."""

    def __init__(self) -> None:
        self._tracks: dict[int, JointTrack | PoseTrack] = {}  # by env

    @abstractmethod
    def track(self, start: EpisodeSpec) -> JointTrack | PoseTrack:
        """Return the track of an episode."""

    def reset(self, starts: list[EpisodeSpec]) -> None:
        """Start the tracks of episodes."""
        for start in starts:
            self._tracks[start.env] = self.track(start)

    def act(self, observations: Observations) -> Array:
        """Return (E, A) actions."""
        envs = observations.envs.tolist()
        return np.stack([self._tracks[env].next(observations, row) for row, env in enumerate(envs)])
