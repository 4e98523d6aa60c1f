"""Sample episodes at the rate of a dataset; compute motion and commands between samples.

An episode of S control steps has states 0..S. With a stride of k control steps per dataset step, the dataset contains
the states 0, k, 2k, ... and the last state S, so that the goal is always included. If k is not a divisor of S, the last
dataset step is shorter.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.poses import from_wxyz, inverse
from robocas_ms3.robots.description import RobotDescription
from robocas_ms3.robots.description_file import tcp_and_arm_base_poses
from robocas_ms3.robots.registry import RobotSpec

Array = NDArray[np.float64]

_POSE = 13  # length of a body state: position 3, quaternion wxyz 4, linear and angular velocity 6
_JOINTS = RobotDescription.finger_slice.stop


def sample_stride(control_freq: float, rate_hz: float) -> int:
    """Return the number of control steps per dataset step.

    Args:
        control_freq: control rate of the recording, Hz.
        rate_hz: rate of the dataset, Hz.

    Raises:
        DatasetError: the number is not a whole number.
    """
    stride = round(control_freq / rate_hz) if rate_hz > 0 else 0
    if stride < 1 or abs(stride * rate_hz - control_freq) > 1e-6 * control_freq:
        rates = [f"{control_freq / k:g}" for k in range(1, 21) if (control_freq / k).is_integer()]
        raise DatasetError(
            "the rate is not a divisor of the control frequency",
            where="rate",
            expected=f"one of {', '.join(rates)} Hz at {control_freq:g} Hz",
            found=f"{rate_hz:g} Hz",
            usage=True,
        )
    return stride


def sample_states(control_steps: int, stride: int) -> NDArray[np.int64]:
    """Return the indices (T,) of the states that a dataset contains.

    These are every ``stride``-th state, and the last state.

    An episode of ``control_steps`` has ``control_steps + 1`` states.
    """
    indices = np.arange(0, control_steps + 1, stride)
    return indices if indices[-1] == control_steps else np.append(indices, control_steps)


def sample_gripper_commands(
    robot: RobotDescription,
    commands: NDArray[np.floating],
    samples: NDArray[np.int64],
    *,
    initial_width: float,
) -> NDArray[np.bool_]:
    """Return whether the last gripper command before each sampled state opens the gripper (T,).

    Element t + 1 is the command between the samples t and t + 1, as in the loader of RoboCAS-v0. A command to more than
    half of the maximum width counts as open.

    Args:
        robot: description of the robot.
        commands: (S,) gripper actions in [-1, 1].
        samples: (T,) indices of states from `sample_states`.
        initial_width: width of the gripper at the reset, m, which is the command before the first action.
    """
    low, high = robot.finger_targets
    finger_targets = low + (np.clip(commands, -1, 1) + 1) / 2 * (high - low)
    widths = np.concatenate([[initial_width], 2 * finger_targets])
    return widths[samples] > robot.open_width / 2 + 1e-6


def compute_relative_motion(poses: Array, intended: Array | None = None) -> Array:
    """Return the motions (T, 4, 4) between consecutive poses (T, 4, 4): ``inv(pose[t]) @ pose[t + 1]``.

    With ``intended`` (T, 4, 4), a motion leads to the intended pose: ``inv(pose[t]) @ intended[t + 1]``. It corrects
    the deviation of ``pose[t]`` and does not contain the noise of step t. The last motion is the identity.
    """
    goals = poses if intended is None else intended
    return np.concatenate([inverse(poses[:-1]) @ goals[1:], np.eye(4)[None]])


def to_dataset_motion(poses: Array, intended: Array | None = None) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the result of `compute_relative_motion` in the format of datasets.

    Returns:
        Translations (T, 3), m; quaternions (T, 4), xyzw with w >= 0. The last row is no motion.
    """
    motion = compute_relative_motion(poses, intended)
    turns = Rotation.from_matrix(motion[:, :3, :3]).as_quat(canonical=True)
    return motion[:, :3, 3].astype(np.float32), turns.astype(np.float32)


def to_dataset_actions(positions: NDArray, turns: NDArray, gripper_status: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Return dataset actions (T, 7); row t leads from step t to step t + 1.

    The last row holds the pose.

    An action has a translation in m, Euler angles about the fixed axes x, y, z in rad ("xyz" in scipy), and the gripper
    command, 1 open or 0 closed.

    Args:
        positions: (T, 3) translations of `to_dataset_motion`, m.
        turns: (T, 4) quaternions of `to_dataset_motion`, xyzw.
        gripper_status: (T,) result of `sample_gripper_commands`.
    """
    status = np.asarray(gripper_status, dtype=np.float64)
    actions = np.zeros((len(status), 7))
    actions[:-1, :3] = positions[:-1]
    if len(status) > 1:
        actions[:-1, 3:6] = Rotation.from_quat(np.asarray(turns[:-1], np.float64)).as_euler("xyz")
    actions[:-1, 6] = status[1:]
    actions[-1, 6] = status[-1]
    return actions.astype(np.float32)


def compute_agv_pose(root: Array, qpos: Array) -> Array:
    """Return the poses (T, 3) of the mobile base in the world: x, y in m, yaw in rad.

    The first yaw is in [-pi, pi). Later yaws are continuous, and may leave this range.

    Args:
        root: (T, 4, 4) poses of the robot's root link in the world.
        qpos: (T, 12) joint positions: base x, y in m, yaw in rad, arm, fingers.
    """
    x, y, yaw = qpos[:, RobotDescription.base_slice].T
    position = root[:, :3, 3] + np.einsum("tij,tj->ti", root[:, :3, :3], np.stack([x, y, 0 * x], axis=1))
    root_yaw = np.arctan2(root[:, 1, 0], root[:, 0, 0])
    return np.column_stack([position[:, :2], np.asarray(np.unwrap(_wrap(root_yaw + yaw)), dtype=np.float64)])


def compute_agv_motion(agv_pose: NDArray) -> Array:
    """Return the differences (T, 3) of consecutive base poses ``agv_pose`` (T, 3): x, y in m, yaw in rad.

    The last row is 0.
    """
    pose = agv_pose.astype(np.float64)
    motion = np.diff(pose, axis=0, append=pose[-1:])
    motion[:, 2] = _wrap(motion[:, 2])
    return motion


def _wrap(angle: Array) -> Array:
    return (angle + np.pi) % (2 * np.pi) - np.pi


@dataclass(frozen=True)
class Motion:
    """Motion of the robot at the T sampled states of an episode.

    Attributes:
        qpos: (T, 12) joint positions: base x, y, yaw, 7 arm joints, 2 fingers; m and rad.
        qvel: (T, 12) joint velocities; m/s and rad/s.
        root_in_world: (T, 4, 4) poses of the robot's root link.
        tcp_in_world: (T, 4, 4) poses of the TCP, computed from ``qpos``.
        arm_base_in_world: (T, 4, 4) poses of the arm's base, computed from ``qpos``.
        gripper_open: (T,) whether the last gripper command opens the gripper (`sample_gripper_commands`).
        intended_joints: (T, 7) positions of the arm joints without the deviation that action noise has caused; None:
            no noise.
        intended_tcp_in_base: (T, 4, 4) poses of the TCP in the arm's base frame at ``intended_joints``.
    """

    qpos: Array
    qvel: Array
    root_in_world: Array
    tcp_in_world: Array
    arm_base_in_world: Array
    gripper_open: NDArray[np.bool_]
    intended_joints: Array | None = None
    intended_tcp_in_base: Array | None = None

    @classmethod
    def from_states(
        cls,
        robot: RobotSpec,
        robot_states: NDArray[np.floating],
        gripper: NDArray[np.floating],
        samples: NDArray[np.int64],
        deviations: NDArray[np.floating] | None = None,
    ) -> Motion:
        """Compute the motion from recorded states.

        Args:
            robot: specification of the robot.
            robot_states: (S + 1, 37) ManiSkill states of the robot, after the reset and after each control step.
            gripper: (S,) gripper commands in [-1, 1].
            samples: (T,) indices of states from `sample_states`, or a contiguous part of them.
            deviations: (S, 7) deviations of the arm joints that action noise has caused at the end of each control
                step, rad; None: no noise.
        """
        root_in_world, qpos, qvel = split_robot_states(robot_states[samples])
        width = float(split_robot_states(robot_states[:1])[1][0, robot.description.finger_slice].sum())
        gripper_open = sample_gripper_commands(robot.description, gripper, samples, initial_width=width)
        motion = cls.from_joints(robot, root_in_world, qpos, qvel, gripper_open)
        if deviations is None:
            return motion
        intended = qpos.copy()
        intended[:, robot.description.arm_slice] -= np.concatenate([np.zeros((1, 7)), deviations])[samples]
        tcp, base = tcp_and_arm_base_poses(robot, root_in_world, intended)
        joints = intended[:, robot.description.arm_slice]
        return replace(motion, intended_joints=joints, intended_tcp_in_base=inverse(base) @ tcp)

    @classmethod
    def from_joints(
        cls, robot: RobotSpec, root_in_world: Array, qpos: Array, qvel: Array, gripper_open: NDArray[np.bool_]
    ) -> Motion:
        return cls(qpos, qvel, root_in_world, *tcp_and_arm_base_poses(robot, root_in_world, qpos), gripper_open)

    @cached_property
    def tcp_in_base(self) -> Array:
        return inverse(self.arm_base_in_world) @ self.tcp_in_world

    @cached_property
    def tcp_motion(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Intended motions of the TCP in the TCP frame: translations (T, 3) m, quaternions (T, 4) xyzw.

        Without noise they are the motions between the poses ``tcp_in_base``.
        """
        return to_dataset_motion(self.tcp_in_base, self.intended_tcp_in_base)

    @cached_property
    def base_motion(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Motions of the arm's base in the world frame: translations (T, 3) m, quaternions (T, 4) xyzw."""
        return to_dataset_motion(self.arm_base_in_world)

    @cached_property
    def agv_pose(self) -> Array:
        """Poses (T, 3) of the mobile base in the world: x, y in m, yaw in rad."""
        return compute_agv_pose(self.root_in_world, self.qpos)

    @property
    def agv_motion(self) -> Array:
        return compute_agv_motion(self.agv_pose)

    @property
    def actions(self) -> NDArray[np.float32]:
        """Dataset actions (T, 7), the result of `to_dataset_actions`."""
        return to_dataset_actions(*self.tcp_motion, self.gripper_open)


def select_gripper_commands(actions: NDArray[np.floating], control_mode: str) -> NDArray[np.floating]:
    """Return the gripper commands (S,) in recorded actions (S, A) of a control mode."""
    return actions[:, 6 if "_ee_" in control_mode else 7]


def split_robot_states(states: NDArray[np.floating]) -> tuple[Array, Array, Array]:
    """Split ManiSkill robot states (T, 37) into root poses (T, 4, 4), qpos (T, 12), qvel (T, 12)."""
    states = np.asarray(states, dtype=np.float64)
    return (
        from_wxyz(states[:, :7]),
        states[:, _POSE : _POSE + _JOINTS],
        states[:, _POSE + _JOINTS :],
    )
