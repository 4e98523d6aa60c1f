"""From recorded states to the arrays of an episode: pure maths, no simulator.

Which states are kept, and the motion between them: `robocas_ms3.demos.sampling`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocas_ms3.datasets.schema import EPISODE_INFO
from robocas_ms3.demos.sampling import invert, stored_motion
from robocas_ms3.errors import DatasetError
from robocas_ms3.robots.forward import link_poses

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SubGoal:
    """A part of an episode.

    Attributes:
        goal_type: one of ``GOAL_TYPES``.
        goal_description: its text.
        first, last: range of steps, inclusive.
    """

    goal_type: str
    goal_description: str
    first: int
    last: int

    def as_json(self) -> dict:
        """Its form in ``data_info.json``."""
        return {
            "goal_type": self.goal_type,
            "goal_range": [self.first, self.last],
            "goal_description": self.goal_description,
        }


@dataclass(frozen=True)
class Frames:
    """Poses of links at the sampled states.

    Attributes:
        tcp_in_world: (T, 4, 4).
        arm_base_in_world: (T, 4, 4).
    """

    tcp_in_world: Array
    arm_base_in_world: Array


@dataclass(frozen=True)
class Joints:
    """Joint states at the sampled states.

    Attributes:
        qpos: (T, 12) base x, y, yaw, 7 arm joints, 2 fingers.
        qvel: (T, 12) the same order.
        root_in_world: (T, 4, 4) the robot's root.
    """

    qpos: Array
    qvel: Array
    root_in_world: Array


def robot_frames(joints: Joints) -> Frames:
    """Link poses by forward kinematics."""
    return Frames(*link_poses(joints.root_in_world, joints.qpos))


def sample_subgoals(subgoals: Sequence[SubGoal], samples: NDArray[np.int64]) -> list[SubGoal]:
    """Carry sub-goals over to the sampled steps.

    A step belongs to the sub-goal of the action that leaves its state, the last step to that of the last action; a
    sub-goal shorter than a stride may hold no step, and is left out.

    Args:
        subgoals: ranges over the actions 0..S-1, in order, without gaps.
        samples: from ``sample_states``.

    Returns:
        Ranges over the sampled steps, in order, without gaps.

    Raises:
        DatasetError: the ranges do not cover the actions.
    """
    actions = int(samples[-1])
    expected_first = 0
    for goal in subgoals:
        if goal.first != expected_first or goal.last < goal.first:
            break
        expected_first = goal.last + 1
    if expected_first != actions:
        raise DatasetError(
            "sub-goals do not cover the actions one after the other",
            where="subgoals",
            expected=f"ranges from 0 to {actions - 1}",
            found=[[goal.first, goal.last] for goal in subgoals],
        )
    owner = np.searchsorted([goal.first for goal in subgoals], np.minimum(samples, actions - 1), side="right") - 1
    result = []
    for index, goal in enumerate(subgoals):
        steps = np.flatnonzero(owner == index)
        if len(steps):
            result.append(SubGoal(goal.goal_type, goal.goal_description, int(steps[0]), int(steps[-1])))
    return result


def to_matrices(positions: Array, xyzw: Array) -> Array:
    """4x4 from positions (..., 3) and quaternions (..., 4) xyzw."""
    result = np.zeros((*positions.shape[:-1], 4, 4))
    result[..., :3, :3] = Rotation.from_quat(xyzw.reshape(-1, 4)).as_matrix().reshape(*xyzw.shape[:-1], 3, 3)
    result[..., :3, 3] = positions
    result[..., 3, 3] = 1
    return result


def wxyz_to_xyzw(quaternions: Array) -> Array:
    """Reorder quaternions (..., 4)."""
    return np.roll(quaternions, -1, axis=-1)


def xyzw_to_wxyz(quaternions: Array) -> Array:
    """Reorder quaternions (..., 4)."""
    return np.roll(quaternions, 1, axis=-1)


def continuous_xyzw(poses: Array) -> Array:
    """Orientations of (T, 4, 4) as (T, 4) xyzw: w >= 0 in the first row, no jump of the sign after it."""
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat(canonical=True)
    flips = np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0
    quaternions[1:] *= np.where(np.cumsum(flips) % 2, -1.0, 1.0)[:, None]
    return quaternions


def compose(first: Array, relative: Array) -> Array:
    """Poses (T, 4, 4) from the first one (4, 4) and ``relative_motion`` (T, 4, 4)."""
    poses = [first]
    for motion in relative[:-1]:
        poses.append(poses[-1] @ motion)
    return np.stack(poses)


def wrap_angle(angle: Array) -> Array:
    """Angles in [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def planar_base(joints: Joints) -> Array:
    """Mobile base in the world: (T, 3) x, y in m, yaw in rad, at first in [-pi, pi), without jumps after that."""
    x, y, yaw = joints.qpos[:, :3].T
    root = joints.root_in_world
    position = root[:, :3, 3] + np.einsum("tij,tj->ti", root[:, :3, :3], np.stack([x, y, 0 * x], axis=1))
    root_yaw = np.arctan2(root[:, 1, 0], root[:, 0, 0])
    return np.column_stack([position[:, :2], np.unwrap(wrap_angle(root_yaw + yaw))])


def episode_arrays(
    frames: Frames,
    joints: Joints,
    gripper_status: NDArray[np.bool_],
    instruction: str,
    subgoals: Sequence[SubGoal],
    embed=None,
) -> dict[str, np.ndarray]:
    """Every array of ``episode_info.npz``.

    Args:
        frames: link poses at the T sampled states.
        joints: joint states at the same.
        gripper_status: (T,) from ``gripper_open``.
        instruction: the whole episode's.
        subgoals: from ``sample_subgoals``.
        embed: texts -> (N, 384); None leaves the embeddings out.
    """
    ee_in_base = invert(frames.arm_base_in_world) @ frames.tcp_in_world
    rel_pos, rel_orn = stored_motion(ee_in_base)
    base_rel_pos, base_rel_orn = stored_motion(frames.arm_base_in_world)
    agv = planar_base(joints)
    agv_motion = np.concatenate([np.diff(agv, axis=0), np.zeros((1, 3))])
    agv_motion[:, 2] = wrap_angle(agv_motion[:, 2])
    texts = [goal.goal_description for goal in subgoals for _ in range(goal.last - goal.first + 1)]
    values = {
        "rel_pos": rel_pos,
        "rel_orn": rel_orn,
        "ee_pos": ee_in_base[:, :3, 3],
        "ee_orn": continuous_xyzw(ee_in_base),
        "robot_joints": joints.qpos[:, 3:10],
        "arm_joint_vel": joints.qvel[:, 3:10],
        "base_pos": frames.arm_base_in_world[:, :3, 3],
        "base_orn": continuous_xyzw(frames.arm_base_in_world),
        "base_rel_pos": base_rel_pos,
        "base_rel_orn": base_rel_orn,
        "gripper_width": joints.qpos[:, 10] + joints.qpos[:, 11],
        "gripper_status": gripper_status,
        "agv_pose": agv,
        "rel_agv_pose": agv_motion,
        "episode_length": len(agv),
        "language_goal": instruction,
        "step_lang_goals": texts,
        "step_goal_type": [goal.goal_type for goal in subgoals for _ in range(goal.last - goal.first + 1)],
    }
    if embed is not None:
        values["language_embedding"] = embed([instruction])[0]
        values["step_goal_embs"] = embed(texts)
    return {spec.name: spec.cast(values[spec.name]) for spec in EPISODE_INFO if spec.name in values}
