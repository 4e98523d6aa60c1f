"""The quantities that are observed of a robot and recorded of it, one entry each.

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
    """An array of an episode.

    Attributes:
        name: its key.
        dtype: its type; ``str`` is numpy's fixed-width unicode.
        shape: lengths; ``"T"`` is the number of steps.
        unit: of its numbers.
        meaning: for people.
        quaternion: rows are unit quaternions xyzw.
        embedding: rows are sentence embeddings; absent from datasets converted without.
        limits: least and greatest value; None: any.
        optional: a dataset may lack it: one that was written before the entry was added, or of a format without it.
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
    """A quantity of each step.

    Attributes:
        observed: computes it (N, ...) of an agent (`agent.MobileManipulator`), for ``obs["agent"]`` of environments;
            None: it is not observed.
        policy: its name in the observations and remote messages of policies; empty: they do not get it.
        recorded: computes it (T, ...) of a motion (`demos.recordings.motion.Motion`), for ``episode_info.npz``; None:
            it is not recorded.
        feature: LeRobot feature that holds it, next to the others of that feature; empty: none does. An optional
            quantity has none: LeRobot datasets hold every feature in every episode.
        components: names of its numbers there; default: its own, numbered where it has several.
    """

    observe: Callable[[Any], Any] | None = None
    policy_key: str = ""
    record: Callable[[Any], Any] | None = None
    lerobot_feature: str = ""
    components: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.optional and self.lerobot_feature:
            raise ValueError(f"an optional quantity has no LeRobot feature: {self.name}, {self.lerobot_feature}")

    @property
    def width(self) -> int:
        return int(np.prod(self.shape_for(1)))

    @property
    def names(self) -> tuple[str, ...]:
        numbered = (self.name,) if self.width == 1 else tuple(f"{self.name}_{i}" for i in range(1, self.width + 1))
        return self.components or numbered


def continuous_xyzw(poses: Array) -> Array:
    """Return the orientations of poses (T, 4, 4) as (T, 4) xyzw: w >= 0 in the first row, no sign flips after it."""
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat(canonical=True)
    flips = np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0
    quaternions[1:] *= np.where(np.cumsum(flips) % 2, -1.0, 1.0)[:, None]
    return quaternions


_JOINTS = tuple(f"joint_{number}" for number in range(1, 8))
_XYZ, _XYZW = ("x", "y", "z"), ("qx", "qy", "qz", "qw")
GRIPPER_WIDTH = "gripper_width"
"""Key of the distance between the finger pads, in observations, remote messages and recordings."""
STATE, ARM_BASE = "observation.state", "observation.arm_base"
"""LeRobot features that hold several quantities."""
_EE = "EEF (TCP) in the arm base frame (panda_link0)"
_BASE = "arm base in the world"

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
        "EEF from step t to t+1, in the EEF frame at t; last row 0",
        record=lambda motion: motion.tcp_motion[0],
    ),
    Quantity(
        "rel_orn",
        "float32",
        ("T", 4),
        "xyzw",
        "the same turn; last row the identity",
        quaternion=True,
        record=lambda motion: motion.tcp_motion[1],
    ),
    Quantity(
        "ee_pos",
        "float32",
        ("T", 3),
        "m",
        _EE,
        record=lambda motion: motion.tcp_in_base[:, :3, 3],
        lerobot_feature=STATE,
        components=_XYZ,
    ),
    Quantity(
        "ee_orn",
        "float32",
        ("T", 4),
        "xyzw",
        _EE,
        quaternion=True,
        record=lambda motion: continuous_xyzw(motion.tcp_in_base),
        lerobot_feature=STATE,
        components=_XYZW,
    ),
    Quantity(
        "robot_joints",
        "float32",
        ("T", 7),
        "rad",
        "arm joints",
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
        _BASE,
        record=lambda motion: motion.arm_base_in_world[:, :3, 3],
        lerobot_feature=ARM_BASE,
        components=_XYZ,
    ),
    Quantity(
        "base_orn",
        "float32",
        ("T", 4),
        "xyzw",
        _BASE,
        quaternion=True,
        record=lambda motion: continuous_xyzw(motion.arm_base_in_world),
        lerobot_feature=ARM_BASE,
        components=_XYZW,
    ),
    Quantity(
        "base_rel_pos",
        "float32",
        ("T", 3),
        "m",
        "as rel_pos, of the arm base",
        record=lambda motion: motion.base_motion[0],
    ),
    Quantity(
        "base_rel_orn",
        "float32",
        ("T", 4),
        "xyzw",
        "as rel_orn, of the arm base",
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
        "command in force at this step: True = open (commanded width > 0.04 m)",
        record=lambda motion: motion.gripper_open,
        lerobot_feature="observation.gripper_open",
        components=("gripper_open",),
    ),
    Quantity(
        "agv_pose",
        "float32",
        ("T", 3),
        "m, m, rad",
        "mobile base in the world: x, y, yaw, which never jumps",
        record=lambda motion: motion.agv_pose,
        lerobot_feature=STATE,
        components=("agv_x", "agv_y", "agv_yaw"),
    ),
    Quantity(
        "rel_agv_pose",
        "float32",
        ("T", 3),
        "m, m, rad",
        "agv_pose[t+1] - agv_pose[t] (world frame); last row 0",
        record=lambda motion: motion.agv_motion,
    ),
)


def lerobot_features() -> dict[str, list[Quantity]]:
    """Return the quantities that each LeRobot feature of observations holds, in their order."""
    found: dict[str, list[Quantity]] = {}
    for quantity in QUANTITIES:
        if quantity.lerobot_feature:
            found.setdefault(quantity.lerobot_feature, []).append(quantity)
    return found


def feature_columns(feature: str) -> dict[str, slice]:
    """Return the columns of each quantity in a LeRobot feature (T, D), by its name."""
    columns, first = {}, 0
    for quantity in lerobot_features()[feature]:
        columns[quantity.name] = slice(first, first := first + quantity.width)
    return columns
