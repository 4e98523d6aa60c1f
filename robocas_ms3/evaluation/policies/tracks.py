"""Policies that follow a track: joint targets, or poses of the TCP, that were found or recorded before."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocas_ms3.demos.recordings.motion import Motion, sample_states
from robocas_ms3.evaluation.policy import Observations
from robocas_ms3.robots.description import RobotDescription
from robocas_ms3.robots.table import RobotSpec

Array = NDArray[np.floating]


class Track(Protocol):
    """What to do in an episode, a policy step after the other."""

    def next(self, observations: Observations, row: int) -> Array:
        """(A,) the next action, where row ``row`` shows what is so; after the last one, what holds still."""
        ...


@dataclass
class JointTrack:
    """Joint targets.

    Attributes:
        actions: (S, 8); none: it stays where it is.
        played: how many of them are over.
    """

    actions: Array
    played: int = 0

    def next(self, observations: Observations, row: int) -> Array:
        """(8,) joint targets; see `Track`."""
        if not len(self.actions):
            self.actions = np.append(observations.qpos[row, RobotDescription.arm_slice], 1.0)[None]
        action = self.actions[min(self.played, len(self.actions) - 1)]
        self.played += 1
        return action


@dataclass
class PoseTrack:
    """Poses that the TCP is to be at, one a policy step: each action leads there from where the TCP is by then.

    Attributes:
        poses: (S, 4, 4) in the arm's base frame; none: it stays where it is.
        open: (S,) bool, the gripper's commands.
        played: how many of them are over.
    """

    poses: Array
    open: NDArray[np.bool_]
    played: int = 0

    @classmethod
    def of(cls, robot: RobotSpec, robot_states: Array, gripper: Array, stride: int) -> PoseTrack:
        """The track of a recording.

        Args:
            robot: whose it is.
            robot_states: (S + 1, 37) after the reset and after each control step.
            gripper: (S,) commands in [-1, 1].
            stride: control steps a policy step.
        """
        samples = sample_states(len(gripper), stride)
        motion = Motion.of(robot, robot_states, gripper, samples)
        return cls(motion.tcp_in_base[1:], motion.gripper_open[1:])

    def next(self, observations: Observations, row: int) -> Array:
        """(7,) a motion in RoboCAS' convention; see `Track`."""
        place = min(self.played, len(self.poses) - 1)
        self.played += 1
        if place < 0:
            return np.array([0, 0, 0, 0, 0, 0, 1.0])
        here = observations.tcp_in_base[row].astype(np.float64)
        turn = Rotation.from_quat(here[[4, 5, 6, 3]]).inv()
        motion = turn.apply(self.poses[place, :3, 3] - here[:3])
        angles = (turn * Rotation.from_matrix(self.poses[place, :3, :3])).as_euler("xyz")
        return np.array([*motion, *angles, float(self.open[place])])


class Followers:
    """The tracks of all envs."""

    def __init__(self) -> None:
        self._tracks: dict[int, Track] = {}

    def begin(self, env: int, track: Track) -> None:
        """Set out on an episode's track in an env."""
        self._tracks[env] = track

    def act(self, observations: Observations) -> Array:
        """(E, A) actions."""
        envs = observations.envs.tolist()
        return np.stack([self._tracks[env].next(observations, row) for row, env in enumerate(envs)])
