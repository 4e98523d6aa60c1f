"""Motions of the arm as commands of a policy, from one observation to the next."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from robocas_ms3.baselines.keyframe.motion import ArmPaths, PathFollower
from robocas_ms3.baselines.keyframe.perception import CameraFrame
from robocas_ms3.core.poses import Array, inverse

OPEN, CLOSED = 1.0, 0.0
"""Gripper commands of the convention ``robocas``."""
PRECISE, COARSE = (0.004, 0.03), (0.02, 0.1)
"""m and rad from the goal at which a motion ends."""
NEAR_START = (0.008, 0.05)
"""m and rad from a pre-grasp at which the motion to it ends."""
_WAIT = 4  # control steps of 0.2 s in which the gripper closes or opens
_ARRIVED = 0.05  # m from the goal, within which a motion was not stopped
_FAR, _PROGRESS = 0.03, 0.002  # m from the path, beyond which the arm first moves to it; m per step that are progress
_PATIENCE = 5  # policy steps without progress, after which a motion ends


@dataclass(frozen=True)
class EpisodeObservation:
    """Observation of one env.

    Attributes:
        tcp_in_base: (4, 4) TCP pose in the arm's base frame.
        qpos: (7,) joint angles of the arm, rad.
        width: gripper width, m.
        frames: images by camera name; empty if none were requested.
    """

    tcp_in_base: Array
    qpos: Array
    width: float
    frames: dict[str, CameraFrame]


@dataclass(frozen=True)
class Command:
    """Command of one policy step.

    Attributes:
        action: (7,) action of the convention ``robocas``, relative to the present TCP pose.
        requests_images: whether the next observation needs images.
    """

    action: Array
    requests_images: bool = False


Motion = Generator[Command, EpisodeObservation, EpisodeObservation]
"""Generator that yields commands, receives observations, and returns the last observation."""


class MotionError(Exception):
    """The arm has no path for a motion, or was stopped.

    Args:
        observation: last observation.
    """

    def __init__(self, observation: EpisodeObservation) -> None:
        self.observation = observation


class ArmControl:
    """Motions of the arm and the gripper.

    Args:
        paths: kinematics of the arm.
        control_steps: control steps of 0.2 s per policy step.
    """

    def __init__(self, paths: ArmPaths, control_steps: int) -> None:
        self.paths, self._control_steps = paths, control_steps

    def request_images(self, observation: EpisodeObservation, gripper: float) -> Motion:
        """Hold the pose for one step, and return an observation with images."""
        action = _make_action(observation, observation.tcp_in_base, gripper)
        return (yield Command(action, requests_images=True))

    def wait(self, observation: EpisodeObservation, gripper: float) -> Motion:
        """Hold the pose until the gripper has closed or opened."""
        for _ in range(-(-_WAIT // self._control_steps)):
            observation = yield Command(_make_action(observation, observation.tcp_in_base, gripper))
        return observation

    def follow(
        self,
        observation: EpisodeObservation,
        path: Array,
        gripper: float,
        tolerance: tuple[float, float] = PRECISE,
        speed: float = 1.0,
    ) -> Motion:
        """Follow a path (n, 7) until the arm arrives or makes no progress; ``speed`` is a fraction of the limits."""
        follower, index, waited = PathFollower(self.paths.chain, path, self._control_steps, speed), -1, 0
        nearest = np.inf
        while waited < _PATIENCE:
            pose = follower.next_pose(observation.tcp_in_base)
            observation = yield Command(_make_action(observation, pose, gripper))
            error = inverse(observation.tcp_in_base) @ follower.goal
            turn = Rotation.from_matrix(error[:3, :3]).magnitude()
            if follower.is_last and np.linalg.norm(error[:3, 3]) < tolerance[0] and turn < tolerance[1]:
                break
            distance = follower.measure_distance(observation.tcp_in_base)
            if follower.index > index or distance > _FAR and distance < nearest - _PROGRESS:
                waited, nearest = 0, distance
            else:
                waited += 1
            index = follower.index
        return observation

    def find_nearest(self, observation: EpisodeObservation, path: Array) -> int:
        """Return the index of the configuration of a path (n, 7) whose TCP is nearest to the present one."""
        return int(self._measure_distances(observation, path).argmin())

    def _measure_distances(self, observation: EpisodeObservation, path: Array) -> Array:
        positions = self.paths.chain.tcp(path)[:, :3, 3]
        return np.linalg.norm(positions - observation.tcp_in_base[:3, 3], axis=1)

    def follow_or_return(
        self,
        observation: EpisodeObservation,
        path: Array,
        gripper: float,
        tolerance: tuple[float, float] = PRECISE,
        speed: float = 1.0,
    ) -> Motion:
        """Follow a path; if the arm is stopped before its end, move back to the start and raise MotionError."""
        start = observation.qpos
        observation = yield from self.follow(observation, path, gripper, tolerance, speed)
        distances = self._measure_distances(observation, path)
        if distances[-1] < _ARRIVED:
            return observation
        back = np.concatenate([path[int(distances.argmin()) :: -1], start[None]])
        observation = yield from self.follow(observation, back, gripper, COARSE, speed)
        raise MotionError(observation)

    def move_joints(
        self, observation: EpisodeObservation, goal: Array, gripper: float, tolerance: tuple[float, float] = COARSE
    ) -> Motion:
        """Move straight in joint space to a configuration (7,)."""
        path = self.paths.joint(observation.qpos, goal)
        return (yield from self.follow(observation, path, gripper, tolerance))

    def move_straight(self, observation: EpisodeObservation, tcp_in_base: Array, gripper: float) -> Motion:
        """Move the TCP on a straight line to a pose (4, 4); raise MotionError without a path."""
        path = self.paths.straight(observation.qpos, tcp_in_base)
        if path is None:
            raise MotionError(observation)
        return (yield from self.follow(observation, path, gripper))

    def rise(self, observation: EpisodeObservation, height: float, gripper: float) -> Motion:
        """Raise the TCP to a height in m, unless it is higher; raise MotionError without a path."""
        if observation.tcp_in_base[2, 3] >= height - 0.01:
            return observation
        path = self.paths.rise(observation.qpos, observation.tcp_in_base, height)
        if path is None:
            raise MotionError(observation)
        return (yield from self.follow(observation, path, gripper, COARSE))


def _make_action(observation: EpisodeObservation, tcp_in_base: Array, gripper: float) -> Array:
    """Return the action (7,) that moves the TCP to a pose (4, 4)."""
    motion = inverse(observation.tcp_in_base) @ tcp_in_base
    return np.array([*motion[:3, 3], *Rotation.from_matrix(motion[:3, :3]).as_euler("xyz"), gripper])
