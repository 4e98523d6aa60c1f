"""Robot state in observations of LeRobot environments, with the columns of our LeRobot datasets; keys of cameras."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.poses import from_wxyz, inverse
from robocas_ms3.datasets.lerobot import schema
from robocas_ms3.datasets.lerobot.arrays import to_frame_columns
from robocas_ms3.datasets.sources.arrays import make_episode_arrays
from robocas_ms3.demos.recordings.motion import Motion, sample_gripper_commands
from robocas_ms3.robots.description_file import chain_poses
from robocas_ms3.robots.quantities import ARM_BASE, STATE, feature_columns, lerobot_features
from robocas_ms3.robots.registry import find_robot

KEYS = {"agent_pos": STATE} | {key.removeprefix("observation."): key for key in lerobot_features() if key != STATE}
"""Column of LeRobot datasets by key of the observation of a LeRobot environment."""
WIDTHS = {name: next(one.width for one in schema.FEATURES if one.key == column) for name, column in KEYS.items()}
_QUATERNIONS = {"agent_pos": feature_columns(STATE)["ee_orn"], "arm_base": feature_columns(ARM_BASE)["base_orn"]}
_YAW = feature_columns(STATE)["agv_pose"].stop - 1  # in agent_pos


def depth_key(camera: str) -> str:
    """Return the key of the depth image of a camera in observations, to which LeRobot adds ``observation.``."""
    return schema.depth_key(camera).removeprefix("observation.")


def intrinsics_key(camera: str) -> str:
    """Return the key of the intrinsic matrix of a camera in observations."""
    return f"intrinsics.{camera}"


def camera_pose_key(camera: str) -> str:
    """Return the key of the pose of a camera in the arm's base frame in observations."""
    return f"camera_in_base.{camera}"


CALIBRATION_SHAPES = {intrinsics_key: (3, 3), camera_pose_key: (4, 4)}
"""Shape of the values of a camera by function of their key."""


class Proprioception:
    """Robot state of N envs in the columns of LeRobot datasets; call `compute_columns` once per step and env."""

    def __init__(self, robot: str) -> None:
        self._spec = find_robot(robot)

    def reset(self, obs: dict[str, Any]) -> None:
        """Start an episode in each env; ``obs``: first observation of the vector environment, arrays (N, ...)."""
        robot, agent = self._spec.description, obs["agent"]
        poses = (agent["tcp_in_arm_base"], obs["extra"]["tcp_pose"])
        in_base, in_world = (from_wxyz(np.asarray(pose, np.float64)) for pose in poses)
        qpos = np.asarray(agent["qpos"], np.float64)
        base_in_root = chain_poses(
            self._spec.files().urdf, robot.root_link, robot.arm_base_link, qpos[:, robot.base_slice]
        )
        # (N, 4, 4) poses of the root links, which do not move
        self._roots = in_world @ inverse(in_base) @ inverse(base_in_root)
        self._widths = qpos[:, robot.finger_slice].sum(axis=1)  # initial gripper widths, m
        self._last: dict[int, dict[str, NDArray[np.float32]]] = {}  # by env

    def compute_columns(self, env: int, obs: dict[str, Any], gripper: float | None) -> dict[str, NDArray[np.float32]]:
        """Return the values (D,) float32 of an env for each key in `KEYS`.

        Args:
            env: index of the env.
            obs: last observation of the vector environment, arrays (N, ...).
            gripper: last gripper command, -1 closed to 1 open; None: no command in the episode yet.
        """
        qpos, qvel = (obs["agent"][name][env][None].astype(np.float64) for name in ("qpos", "qvel"))
        commands, width = np.array([] if gripper is None else [gripper]), float(self._widths[env])
        gripper_open = sample_gripper_commands(
            self._spec.description, commands, np.array([len(commands)]), initial_width=width
        )
        motion = Motion.from_joints(self._spec, self._roots[env][None], qpos, qvel, gripper_open)
        columns = to_frame_columns(make_episode_arrays(motion, "", []))
        found = {name: columns[column][0] for name, column in KEYS.items()}
        self._last[env] = _remove_jumps(self._last[env], found) if env in self._last else found
        return self._last[env]


def _remove_jumps(
    last_values: dict[str, NDArray[np.float32]], values: dict[str, NDArray[np.float32]]
) -> dict[str, NDArray[np.float32]]:
    """Return the values without sign flips of quaternions and without jumps of the yaw by full turns.

    ``last_values``: values of the step before. Datasets have no such jumps either.
    """
    found = {name: array.copy() for name, array in values.items()}
    for name, turn in _QUATERNIONS.items():
        if last_values[name][turn] @ found[name][turn] < 0:
            found[name][turn] *= -1
    yaw, last = found["agent_pos"][_YAW], last_values["agent_pos"][_YAW]
    found["agent_pos"][_YAW] = yaw + 2 * np.pi * np.round((last - yaw) / (2 * np.pi))
    return found
