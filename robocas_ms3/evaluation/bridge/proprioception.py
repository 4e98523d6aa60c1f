"""What an env's robot feels, in the numbers and by the names of our LeRobot datasets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.datasets.lerobot.schema import FEATURES, frame_columns
from robocas_ms3.datasets.sources.arrays import episode_arrays
from robocas_ms3.poses import from_wxyz, inverse
from robocas_ms3.recordings.motion import Motion, gripper_open
from robocas_ms3.robots.forward import chain
from robocas_ms3.robots.table import RobotSpec

KEYS = {
    "agent_pos": "observation.state",
    "joint_velocity": "observation.joint_velocity",
    "arm_base": "observation.arm_base",
    "gripper_open": "observation.gripper_open",
}
"""Name in an observation of LeRobot's environments -> column of our datasets."""
WIDTHS = {name: next(one.width for one in FEATURES if one.key == column) for name, column in KEYS.items()}
_TURNS = {"agent_pos": slice(3, 7), "arm_base": slice(3, 7)}  # quaternions, whose sign must not jump
_YAW = 17  # of agent_pos, which does not jump either


@dataclass
class _Robot:
    """Of one episode.

    Attributes:
        spec: which it is.
        root: (4, 4) in the world; it stands still.
        width: of the gripper at first, m.
        last: what was read last.
    """

    spec: RobotSpec
    root: NDArray[np.float64]
    width: float
    last: dict[str, NDArray[np.float32]] | None = None


class Proprioception:
    """Reads observations of several envs, one after another of each episode."""

    def __init__(self) -> None:
        self._robots: dict[int, _Robot] = {}

    def begin(self, env: int, obs: dict[str, Any], spec: RobotSpec) -> None:
        """An episode begins.

        Args:
            env: row of the observation.
            obs: the first one.
            spec: its robot.
        """
        robot = spec.description
        qpos, tcp_in_base, tcp_in_world = _row(obs, env)
        base_in_root = chain(spec.files().urdf, robot.root_link, robot.arm_base_link, qpos[:, robot.base_slice])
        root = from_wxyz(tcp_in_world) @ inverse(from_wxyz(tcp_in_base)) @ inverse(base_in_root)
        self._robots[env] = _Robot(spec, root, float(qpos[0, robot.finger_slice].sum()))

    def read(self, env: int, obs: dict[str, Any], gripper: float | None) -> dict[str, NDArray[np.float32]]:
        """The numbers (D,) of `KEYS`.

        Args:
            env: row of the observation.
            obs: of the environment.
            gripper: its command in force, -1 closed to 1 open; None: there was none yet.
        """
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
    """(1, ...) joint positions, and poses of the TCP in the arm's base and in the world."""
    agent = obs["agent"]
    parts = (agent["qpos"], agent["tcp_in_arm_base"], obs["extra"]["tcp_pose"])
    return tuple(np.asarray(part[env], np.float64)[None] for part in parts)


def _continued(
    before: dict[str, NDArray[np.float32]], now: dict[str, NDArray[np.float32]]
) -> dict[str, NDArray[np.float32]]:
    """The same, without jumps of signs and of whole turns, as an episode of a dataset has none."""
    found = {name: values.copy() for name, values in now.items()}
    for name, turn in _TURNS.items():
        if before[name][turn] @ found[name][turn] < 0:
            found[name][turn] *= -1
    yaw, last = found["agent_pos"][_YAW], before["agent_pos"][_YAW]
    found["agent_pos"][_YAW] = yaw + 2 * np.pi * np.round((last - yaw) / (2 * np.pi))
    return found
