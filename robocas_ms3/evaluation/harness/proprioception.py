"""Robot state in observations of LeRobot environments: the values and names of our LeRobot datasets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.poses import from_wxyz, inverse
from robocas_ms3.datasets.lerobot import schema
from robocas_ms3.datasets.lerobot.arrays import frame_columns
from robocas_ms3.datasets.sources.arrays import episode_arrays
from robocas_ms3.demos.recordings.motion import Motion, gripper_open
from robocas_ms3.robots.description_file import chain
from robocas_ms3.robots.quantities import ARM_BASE, STATE, columns_of, features
from robocas_ms3.robots.table import RobotSpec

KEYS = {"agent_pos": STATE} | {key.removeprefix("observation."): key for key in features() if key != STATE}
"""Key of an environment's observation -> column of our LeRobot datasets."""
WIDTHS = {name: next(one.width for one in schema.FEATURES if one.key == column) for name, column in KEYS.items()}
_QUATERNIONS = {"agent_pos": columns_of(STATE)["ee_orn"], "arm_base": columns_of(ARM_BASE)["base_orn"]}
_YAW = columns_of(STATE)["agv_pose"].stop - 1  # in agent_pos


def depth_key(camera: str) -> str:
    """Return the key of a camera's depth in observations; LeRobot puts ``observation.`` before it."""
    return schema.depth_key(camera).removeprefix("observation.")


@dataclass
class _Robot:
    """Robot of one episode."""

    spec: RobotSpec
    root: NDArray[np.float64]  # (4, 4) pose of its root link in the world, which is constant
    width: float  # of the gripper at the start, m
    last: dict[str, NDArray[np.float32]] | None = None  # last values of `Proprioception.read`


class Proprioception:
    """Reads the robot state of several envs, step by step."""

    def __init__(self) -> None:
        self._robots: dict[int, _Robot] = {}

    def reset(self, env: int, obs: dict[str, Any], spec: RobotSpec) -> None:
        """Start an episode of a robot with its first observation, whose row is ``env``."""
        robot = spec.description
        qpos, tcp_in_base, tcp_in_world = _row(obs, env)
        base_in_root = chain(spec.files().urdf, robot.root_link, robot.arm_base_link, qpos[:, robot.base_slice])
        root = from_wxyz(tcp_in_world) @ inverse(from_wxyz(tcp_in_base)) @ inverse(base_in_root)
        self._robots[env] = _Robot(spec, root, float(qpos[0, robot.finger_slice].sum()))

    def read(self, env: int, obs: dict[str, Any], gripper: float | None) -> dict[str, NDArray[np.float32]]:
        """Return the values (D,) of each of `KEYS`; ``gripper``: last command, -1 closed to 1 open, None: none yet."""
        robot, qpos = self._robots[env], _row(obs, env)[0]
        qvel = obs["agent"]["qvel"][env][None].astype(np.float64)
        commands = np.array([] if gripper is None else [gripper])
        opened = gripper_open(robot.spec.description, commands, np.array([len(commands)]), initial_width=robot.width)
        motion = Motion.of_joints(robot.spec, robot.root, qpos, qvel, opened)
        columns = frame_columns(episode_arrays(motion, "", []))
        found = {name: columns[column][0] for name, column in KEYS.items()}
        robot.last = found if robot.last is None else _continued(robot.last, found)
        return robot.last


def _row(obs: dict[str, Any], env: int) -> tuple[NDArray[np.float64], ...]:
    """Return joint positions (1, J) and the TCP's poses (1, 7) in the arm's base frame and in the world frame."""
    agent = obs["agent"]
    parts = (agent["qpos"], agent["tcp_in_arm_base"], obs["extra"]["tcp_pose"])
    return tuple(np.asarray(part[env], np.float64)[None] for part in parts)


def _continued(
    before: dict[str, NDArray[np.float32]], now: dict[str, NDArray[np.float32]]
) -> dict[str, NDArray[np.float32]]:
    """Return the values without sign flips of quaternions and jumps by full turns, as in an episode of a dataset."""
    found = {name: values.copy() for name, values in now.items()}
    for name, turn in _QUATERNIONS.items():
        if before[name][turn] @ found[name][turn] < 0:
            found[name][turn] *= -1
    yaw, last = found["agent_pos"][_YAW], before["agent_pos"][_YAW]
    found["agent_pos"][_YAW] = yaw + 2 * np.pi * np.round((last - yaw) / (2 * np.pi))
    return found
