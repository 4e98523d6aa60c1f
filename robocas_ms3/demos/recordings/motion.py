"""From control steps to the steps of a dataset: which states are kept, and the motion and commands between them.

An episode of S control steps has states 0..S. With a stride of k control steps a dataset step, the states 0, k, 2k, ...
are kept, and the last state S too, so that the goal is always in the data; where k does not divide S the last dataset
step alone is shorter.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.poses import from_wxyz, inverse
from robocas_ms3.robots.description import RobotDescription
from robocas_ms3.robots.description_file import tcp_and_base_poses
from robocas_ms3.robots.registry import RobotSpec

Array = NDArray[np.float64]

_POSE = 13  # of a state: position 3, quaternion wxyz 4, linear and angular velocity 6
_JOINTS = RobotDescription.finger_slice.stop


def sample_stride(control_freq: float, rate_hz: float) -> int:
    """Return the control steps between two dataset steps."""
    stride = round(control_freq / rate_hz) if rate_hz > 0 else 0
    if stride < 1 or abs(stride * rate_hz - control_freq) > 1e-6 * control_freq:
        rates = [f"{control_freq / k:g}" for k in range(1, 21) if (control_freq / k).is_integer()]
        raise DatasetError(
            "the rate must divide the control frequency",
            where="rate",
            expected=f"one of {', '.join(rates)} Hz at {control_freq:g} Hz",
            found=f"{rate_hz:g}",
        )
    return stride


def sample_states(control_steps: int, stride: int) -> NDArray[np.int64]:
    """Return the indices of ``control_steps + 1`` states to keep: every ``stride``-th and the last."""
    indices = np.arange(0, control_steps + 1, stride)
    return indices if indices[-1] == control_steps else np.append(indices, control_steps)


def gripper_open(
    robot: RobotDescription,
    commands: NDArray[np.floating],
    samples: NDArray[np.int64],
    *,
    initial_width: float,
) -> NDArray[np.bool_]:
    """Return the gripper command (T,) bool in force at each sampled state: that of the action which led there.

    So ``gripper_status[t + 1]`` is what was commanded between t and t + 1, as the released loader reads it. More than
    half open counts as open.

    Args:
        commands: (S,) gripper actions in [-1, 1].
        samples: (T,) from ``sample_states``.
        initial_width: of the gripper at reset, m, which is its target until the first action.
    """
    low, high = robot.finger_targets
    finger_targets = low + (np.clip(commands, -1, 1) + 1) / 2 * (high - low)
    widths = np.concatenate([[initial_width], 2 * finger_targets])
    return widths[samples] > robot.open_width / 2 + 1e-6


def relative_motion(poses: Array) -> Array:
    """Return ``inv(pose[t]) pose[t + 1]`` (T, 4, 4); the last one is the identity."""
    return np.concatenate([inverse(poses[:-1]) @ poses[1:], np.eye(4)[None]])


def stored_motion(poses: Array) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return ``relative_motion`` as datasets store it: positions (T, 3) m and quaternions (T, 4) xyzw, w >= 0."""
    motion = relative_motion(poses)
    turns = Rotation.from_matrix(motion[:, :3, :3]).as_quat(canonical=True)
    return motion[:, :3, 3].astype(np.float32), turns.astype(np.float32)


def stored_actions(positions: NDArray, turns: NDArray, gripper_status: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Return RoboCAS' actions (T, 7) of `stored_motion`; row t leads from step t to t + 1, so the last one holds.

    Motion in m and, about the fixed axes x, y, z (scipy's "xyz"), Euler angles in rad; the gripper's command is
    ``gripper_status[t + 1]`` of `gripper_open`, 1 = open.
    """
    status = np.asarray(gripper_status, dtype=np.float64)
    actions = np.zeros((len(status), 7))
    actions[:-1, :3] = positions[:-1]
    if len(status) > 1:
        actions[:-1, 3:6] = Rotation.from_quat(np.asarray(turns[:-1], np.float64)).as_euler("xyz")
    actions[:-1, 6] = status[1:]
    actions[-1, 6] = status[-1]
    return actions.astype(np.float32)


def planar_base(root: Array, qpos: Array) -> Array:
    """Return the mobile base in the world, (T, 3) x, y in m, yaw in rad: first in [-pi, pi), then without jumps.

    Args:
        root: (T, 4, 4) of the robot in the world.
        qpos: (T, 12).
    """
    x, y, yaw = qpos[:, RobotDescription.base_slice].T
    position = root[:, :3, 3] + np.einsum("tij,tj->ti", root[:, :3, :3], np.stack([x, y, 0 * x], axis=1))
    root_yaw = np.arctan2(root[:, 1, 0], root[:, 0, 0])
    return np.column_stack([position[:, :2], np.asarray(np.unwrap(_wrap(root_yaw + yaw)), dtype=np.float64)])


def planar_motion(agv_pose: NDArray) -> Array:
    """Return the differences (T, 3) of x, y, yaw; the last row is 0."""
    pose = agv_pose.astype(np.float64)
    motion = np.diff(pose, axis=0, append=pose[-1:])
    motion[:, 2] = _wrap(motion[:, 2])
    return motion


def _wrap(angle: Array) -> Array:
    return (angle + np.pi) % (2 * np.pi) - np.pi


@dataclass(frozen=True)
class Motion:
    """Motion of the robot at the T states of an episode that a dataset keeps.

    Attributes:
        qpos: (T, 12) base x, y, yaw, 7 arm joints, 2 fingers, m and rad; ``qvel`` likewise.
        root_in_world: (T, 4, 4); ``tcp_in_world`` and ``arm_base_in_world`` follow by forward kinematics.
        gripper_open: (T,) bool, commands, see `gripper_open`.
    """

    qpos: Array
    qvel: Array
    root_in_world: Array
    tcp_in_world: Array
    arm_base_in_world: Array
    gripper_open: NDArray[np.bool_]

    @classmethod
    def of(
        cls,
        robot: RobotSpec,
        robot_states: NDArray[np.floating],
        gripper: NDArray[np.floating],
        samples: NDArray[np.int64],
    ) -> Motion:
        """Compute the motion in datasets from recorded states, for all of them to the same bit.

        Args:
            robot_states: (S + 1, 37) after the reset and after each control step.
            gripper: (S,) commands in [-1, 1].
            samples: (T,) indices of states, from `sample_states`, or some of them in a row.
        """
        root_in_world, qpos, qvel = split_states(robot_states[samples])
        width = float(split_states(robot_states[:1])[1][0, robot.description.finger_slice].sum())
        opened = gripper_open(robot.description, gripper, samples, initial_width=width)
        return cls.of_joints(robot, root_in_world, qpos, qvel, opened)

    @classmethod
    def of_joints(
        cls, robot: RobotSpec, root_in_world: Array, qpos: Array, qvel: Array, opened: NDArray[np.bool_]
    ) -> Motion:
        return cls(qpos, qvel, root_in_world, *tcp_and_base_poses(robot, root_in_world, qpos), opened)

    @cached_property
    def tcp_in_base(self) -> Array:
        return inverse(self.arm_base_in_world) @ self.tcp_in_world

    @cached_property
    def tcp_motion(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """`stored_motion` of the TCP in the arm's base."""
        return stored_motion(self.tcp_in_base)

    @cached_property
    def base_motion(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """`stored_motion` of the arm's base in the world."""
        return stored_motion(self.arm_base_in_world)

    @cached_property
    def agv_pose(self) -> Array:
        """(T, 3), see `planar_base`."""
        return planar_base(self.root_in_world, self.qpos)

    @property
    def agv_motion(self) -> Array:
        return planar_motion(self.agv_pose)

    @property
    def actions(self) -> NDArray[np.float32]:
        """(T, 7), see `stored_actions`."""
        return stored_actions(*self.tcp_motion, self.gripper_open)


def gripper_commands(actions: NDArray[np.floating], control_mode: str) -> NDArray[np.floating]:
    """Return the gripper's commands (S,) of actions (S, A): after 6 numbers of the end effector, or 7 joints."""
    return actions[:, 6 if "_ee_" in control_mode else 7]


def split_states(states: NDArray[np.floating]) -> tuple[Array, Array, Array]:
    """Return root in the world (T, 4, 4), qpos (T, 12) and qvel (T, 12) of ManiSkill's robot states (T, 37)."""
    states = np.asarray(states, dtype=np.float64)
    return (
        from_wxyz(states[:, :7]),
        states[:, _POSE : _POSE + _JOINTS],
        states[:, _POSE + _JOINTS :],
    )
