"""From recorded states to the arrays of an episode: pure maths, no simulator.

Which states are kept, and the motion between them: `robocas_ms3.demos.recordings.motion`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocas_ms3.datasets.schema import EPISODE_INFO
from robocas_ms3.demos.recordings.motion import Motion, stored_motion
from robocas_ms3.demos.recordings.subgoals import SubGoal
from robocas_ms3.robots.description import RobotDescription

Array = NDArray[np.float64]


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


def planar_base(root: Array, qpos: Array) -> Array:
    """Mobile base in the world: (T, 3) x, y in m, yaw in rad, at first in [-pi, pi), without jumps after that.

    Args:
        root: (T, 4, 4) of the robot in the world.
        qpos: (T, 12).
    """
    x, y, yaw = qpos[:, RobotDescription.base_slice].T
    position = root[:, :3, 3] + np.einsum("tij,tj->ti", root[:, :3, :3], np.stack([x, y, 0 * x], axis=1))
    root_yaw = np.arctan2(root[:, 1, 0], root[:, 0, 0])
    return np.column_stack([position[:, :2], np.asarray(np.unwrap(wrap_angle(root_yaw + yaw)), dtype=np.float64)])


def episode_arrays(
    motion: Motion,
    instruction: str,
    subgoals: Sequence[SubGoal],
) -> dict[str, np.ndarray]:
    """Every array of ``episode_info.npz`` but the embeddings of its texts, see `with_embeddings`.

    Args:
        motion: at the T sampled states.
        instruction: the whole episode's.
        subgoals: from ``sample_subgoals``.
    """
    ee_in_base, base = motion.tcp_in_base, motion.arm_base_in_world
    rel_pos, rel_orn = stored_motion(ee_in_base)
    base_rel_pos, base_rel_orn = stored_motion(base)
    agv = planar_base(motion.root_in_world, motion.qpos)
    agv_motion = np.concatenate([np.diff(agv, axis=0), np.zeros((1, 3))])
    agv_motion[:, 2] = wrap_angle(agv_motion[:, 2])
    texts = [goal.goal_description for goal in subgoals for _ in range(goal.last - goal.first + 1)]
    values = {
        "rel_pos": rel_pos,
        "rel_orn": rel_orn,
        "ee_pos": ee_in_base[:, :3, 3],
        "ee_orn": continuous_xyzw(ee_in_base),
        "robot_joints": motion.qpos[:, RobotDescription.arm_slice],
        "arm_joint_vel": motion.qvel[:, RobotDescription.arm_slice],
        "base_pos": base[:, :3, 3],
        "base_orn": continuous_xyzw(base),
        "base_rel_pos": base_rel_pos,
        "base_rel_orn": base_rel_orn,
        "gripper_width": motion.gripper_width,
        "gripper_status": motion.gripper_open,
        "agv_pose": agv,
        "rel_agv_pose": agv_motion,
        "episode_length": len(agv),
        "language_goal": instruction,
        "step_lang_goals": texts,
        "step_goal_type": [goal.goal_type for goal in subgoals for _ in range(goal.last - goal.first + 1)],
    }
    return {spec.name: spec.cast(values[spec.name]) for spec in EPISODE_INFO if spec.name in values}


def with_embeddings(arrays: Mapping[str, NDArray], embed: Callable[[list[str]], NDArray]) -> dict[str, NDArray]:
    """The same and the embeddings of instruction and sub-goals, in the schema's order; embed: texts -> (N, 384)."""
    made = {
        **arrays,
        "language_embedding": embed([str(arrays["language_goal"])])[0],
        "step_goal_embs": embed(arrays["step_lang_goals"].tolist()),
    }
    return {spec.name: spec.cast(made[spec.name]) for spec in EPISODE_INFO if spec.name in made}
