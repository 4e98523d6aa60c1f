"""Observed and recorded quantities of a robot.

Environments, policies, remote messages, both dataset formats, checks and documentation read `QUANTITIES`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocas_ms3.robots.description import RobotDescription

DataType = Literal["float32", "int64", "bool", "str"]
Array = NDArray[np.float64]


@dataclass(frozen=True)
class ArraySpec:
    """Specification of an array of an episode.

    Attributes:
        name: key of the array.
        dtype: data type; ``str`` is NumPy's fixed-width unicode.
        shape: shape; ``"T"`` stands for the number of steps of the episode.
        unit: unit of the values.
        meaning: description for users.
        quaternion: whether rows are unit quaternions xyzw.
        embedding: whether rows are sentence embeddings, which a dataset may omit.
        limits: smallest and largest valid value; None: unlimited.
        optional: whether an episode, or a dataset of an older version or of another format, may omit the array.
    """

    name: str
    dtype: DataType
    shape: tuple[int | Literal["T"], ...]
    unit: str
    meaning: str
    quaternion: bool = False
    embedding: bool = False
    limits: tuple[float, float] | None = None
    optional: bool = False

    def shape_for(self, steps: int) -> tuple[int, ...]:
        return tuple(steps if length == "T" else length for length in self.shape)

    def has_dtype(self, array: np.ndarray) -> bool:
        return array.dtype.kind == "U" if self.dtype == "str" else array.dtype == np.dtype(self.dtype)

    def cast(self, values: Any) -> np.ndarray:
        return np.asarray(values, dtype=np.str_ if self.dtype == "str" else self.dtype)


@dataclass(frozen=True)
class Quantity(ArraySpec):
    """Specification of a quantity of the robot that has one value or vector per step.

    Attributes:
        observe: returns the quantity (N, ...) of an agent (`agent.MobileManipulator`), for ``obs["agent"]``; None: not
            observed.
        policy_key: name in the observations and remote messages of policies; empty: not available to policies.
        record: returns the quantity (T, ...) of a motion (`demos.recordings.motion.Motion`), for
            ``episode_info.npz``; None: not recorded. For an optional quantity the function may return None.
        lerobot_feature: LeRobot feature that contains the quantity, possibly with others; empty: none. An optional
            quantity must have none, since LeRobot datasets have every feature in every episode.
        components: names of the values in the LeRobot feature; default: the name, numbered if there are several.
    """

    observe: Callable[[Any], Any] | None = None
    policy_key: str = ""
    record: Callable[[Any], Any] | None = None
    lerobot_feature: str = ""
    components: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.optional and self.lerobot_feature:
            what = f"optional quantity {self.name!r} with the LeRobot feature {self.lerobot_feature!r}"
            raise ValueError(f"{what}: set optional=False or remove lerobot_feature")

    @property
    def width(self) -> int:
        return int(np.prod(self.shape_for(1)))

    @property
    def names(self) -> tuple[str, ...]:
        numbered = (self.name,) if self.width == 1 else tuple(f"{self.name}_{i}" for i in range(1, self.width + 1))
        return self.components or numbered


def to_continuous_xyzw(poses: Array) -> Array:
    """Convert the rotations of poses (T, 4, 4) to quaternions xyzw (T, 4) without sign flips between rows.

    The first row has w >= 0.
    """
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat(canonical=True)
    flips = np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0
    quaternions[1:] *= np.where(np.cumsum(flips) % 2, -1.0, 1.0)[:, None]
    return quaternions


_JOINTS = tuple(f"joint_{number}" for number in range(1, 8))
_XYZ, _XYZW = ("x", "y", "z"), ("qx", "qy", "qz", "qw")
GRIPPER_WIDTH = "gripper_width"
"""Key of the finger distance in observations, remote messages and recordings."""
STATE, ARM_BASE = "observation.state", "observation.arm_base"
"""LeRobot features that contain several quantities."""
_EE = "of the EEF (TCP) in the arm base frame (panda_link0)"
_BASE = "of the arm base in the world"

QUANTITIES: tuple[Quantity, ...] = (
    Quantity(
        "qpos",
        "float32",
        ("T", 12),
        "m, rad",
        "base x, y, yaw; 7 arm joints; 2 fingers",
        observe=lambda agent: agent.robot.get_qpos(),
        policy_key="qpos",
    ),
    Quantity(
        "qvel",
        "float32",
        ("T", 12),
        "m/s, rad/s",
        "velocities of qpos",
        observe=lambda agent: agent.robot.get_qvel(),
    ),
    Quantity(
        "tcp_in_arm_base",
        "float32",
        ("T", 7),
        "m",
        "TCP in the arm base frame: position, quaternion wxyz",
        observe=lambda agent: agent.tcp_in_arm_base.raw_pose,
        policy_key="tcp_in_base",
    ),
    Quantity(
        "rel_pos",
        "float32",
        ("T", 3),
        "m",
        "translation of the EEF from step t to t+1, in the EEF frame at t; the last row is 0",
        record=lambda motion: motion.tcp_motion[0],
    ),
    Quantity(
        "rel_orn",
        "float32",
        ("T", 4),
        "xyzw",
        "rotation of the EEF from step t to t+1, in the EEF frame at t; the last row is the identity",
        quaternion=True,
        record=lambda motion: motion.tcp_motion[1],
    ),
    Quantity(
        "ee_pos",
        "float32",
        ("T", 3),
        "m",
        f"position {_EE}",
        record=lambda motion: motion.tcp_in_base[:, :3, 3],
        lerobot_feature=STATE,
        components=_XYZ,
    ),
    Quantity(
        "ee_orn",
        "float32",
        ("T", 4),
        "xyzw",
        f"orientation {_EE}",
        quaternion=True,
        record=lambda motion: to_continuous_xyzw(motion.tcp_in_base),
        lerobot_feature=STATE,
        components=_XYZW,
    ),
    Quantity(
        "robot_joints",
        "float32",
        ("T", 7),
        "rad",
        "positions of the arm joints",
        record=lambda motion: motion.qpos[:, RobotDescription.arm_slice],
        lerobot_feature=STATE,
        components=_JOINTS,
    ),
    Quantity(
        "arm_joint_vel",
        "float32",
        ("T", 7),
        "rad/s",
        "velocities of the arm joints",
        record=lambda motion: motion.qvel[:, RobotDescription.arm_slice],
        lerobot_feature="observation.joint_velocity",
        components=_JOINTS,
    ),
    Quantity(
        "base_pos",
        "float32",
        ("T", 3),
        "m",
        f"position {_BASE}",
        record=lambda motion: motion.arm_base_in_world[:, :3, 3],
        lerobot_feature=ARM_BASE,
        components=_XYZ,
    ),
    Quantity(
        "base_orn",
        "float32",
        ("T", 4),
        "xyzw",
        f"orientation {_BASE}",
        quaternion=True,
        record=lambda motion: to_continuous_xyzw(motion.arm_base_in_world),
        lerobot_feature=ARM_BASE,
        components=_XYZW,
    ),
    Quantity(
        "base_rel_pos",
        "float32",
        ("T", 3),
        "m",
        "translation of the arm base from step t to t+1, in the arm base frame at t; the last row is 0",
        record=lambda motion: motion.base_motion[0],
    ),
    Quantity(
        "base_rel_orn",
        "float32",
        ("T", 4),
        "xyzw",
        "rotation of the arm base from step t to t+1, in the arm base frame at t; the last row is the identity",
        quaternion=True,
        record=lambda motion: motion.base_motion[1],
    ),
    Quantity(
        GRIPPER_WIDTH,
        "float32",
        ("T",),
        "m",
        "distance between the finger pads: sum of both finger joints",
        limits=(-0.005, 0.085),
        observe=lambda agent: agent.gripper_width[:, None],
        policy_key=GRIPPER_WIDTH,
        record=lambda motion: motion.qpos[:, RobotDescription.finger_slice].sum(axis=1),
        lerobot_feature=STATE,
    ),
    Quantity(
        "gripper_status",
        "bool",
        ("T",),
        "",
        "gripper command of the action that ended at this step: True = open (commanded width > 0.04 m)",
        record=lambda motion: motion.gripper_open,
        lerobot_feature="observation.gripper_open",
        components=("gripper_open",),
    ),
    Quantity(
        "agv_pose",
        "float32",
        ("T", 3),
        "m, m, rad",
        "pose of the mobile base in the world: x, y, yaw (yaw is unwrapped: no jumps of 2 pi)",
        record=lambda motion: motion.agv_pose,
        lerobot_feature=STATE,
        components=("agv_x", "agv_y", "agv_yaw"),
    ),
    Quantity(
        "rel_agv_pose",
        "float32",
        ("T", 3),
        "m, m, rad",
        "agv_pose[t+1] - agv_pose[t], in the world; the last row is 0",
        record=lambda motion: motion.agv_motion,
    ),
    Quantity(
        "intended_ee_pos",
        "float32",
        ("T", 3),
        "m",
        f"position {_EE} without the action noise; only in episodes with noise",
        record=lambda motion: None if motion.intended_joints is None else motion.intended_tcp_in_base[:, :3, 3],
        optional=True,
    ),
    Quantity(
        "intended_ee_orn",
        "float32",
        ("T", 4),
        "xyzw",
        f"orientation {_EE} without the action noise; only in episodes with noise",
        quaternion=True,
        record=lambda motion: (
            None if motion.intended_joints is None else to_continuous_xyzw(motion.intended_tcp_in_base)
        ),
        optional=True,
    ),
    Quantity(
        "intended_joints",
        "float32",
        ("T", 7),
        "rad",
        "positions of the arm joints without the action noise; only in episodes with noise",
        record=lambda motion: motion.intended_joints,
        optional=True,
    ),
)


def lerobot_features() -> dict[str, list[Quantity]]:
    """Return the quantities that each LeRobot feature contains, in the order of its columns."""
    found: dict[str, list[Quantity]] = {}
    for quantity in QUANTITIES:
        if quantity.lerobot_feature:
            found.setdefault(quantity.lerobot_feature, []).append(quantity)
    return found


def feature_columns(feature: str) -> dict[str, slice]:
    """Return name of a quantity -> slice of its columns in a LeRobot feature (T, D)."""
    columns, first = {}, 0
    for quantity in lerobot_features()[feature]:
        columns[quantity.name] = slice(first, first := first + quantity.width)
    return columns
