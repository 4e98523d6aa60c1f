"""Convert the arrays of an episode to LeRobot features and back."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocas_ms3.core.poses import from_xyzw
from robocas_ms3.datasets.schema import EPISODE_INFO
from robocas_ms3.demos.recordings.motion import relative_motion


def frame_columns(arrays: dict[str, NDArray]) -> dict[str, NDArray]:
    """Return the numeric features (T, D) of an episode, from the arrays of ``episode_info.npz``."""
    turn = Rotation.from_quat(arrays["rel_orn"].astype(np.float64)).as_euler("xyz")
    status = arrays["gripper_status"].astype(np.float32)[:, None]
    command, joints = _next(status), _next(arrays["robot_joints"])
    parts = {
        "observation.state": (
            arrays["ee_pos"], arrays["ee_orn"], arrays["robot_joints"], arrays["gripper_width"][:, None],
            arrays["agv_pose"],
        ),
        "observation.joint_velocity": (arrays["arm_joint_vel"],),
        "observation.arm_base": (arrays["base_pos"], arrays["base_orn"]),
        "observation.gripper_open": (status,),
        "action": (arrays["rel_pos"], turn, command),
        "action.joint": (joints, command),
        "action.base": (arrays["rel_agv_pose"],),
    }  # fmt: skip
    return {key: np.concatenate(part, axis=1).astype(np.float32) for key, part in parts.items()}


def robocas_arrays(
    columns: dict[str, NDArray], instruction: str, subgoals: list[str], types: list[str]
) -> dict[str, NDArray]:
    """Return the arrays of ``episode_info.npz`` without embeddings; `frame_columns` is the inverse.

    Relative rotations are computed from the absolute ones.
    """
    state, base = columns["observation.state"], columns["observation.arm_base"]
    values: dict[str, Any] = {
        "ee_pos": state[:, :3],
        "ee_orn": state[:, 3:7],
        "robot_joints": state[:, 7:14],
        "gripper_width": state[:, 14],
        "agv_pose": state[:, 15:18],
        "arm_joint_vel": columns["observation.joint_velocity"],
        "base_pos": base[:, :3],
        "base_orn": base[:, 3:],
        "gripper_status": columns["observation.gripper_open"].reshape(-1) > 0.5,
        "rel_pos": columns["action"][:, :3],
        "rel_agv_pose": columns["action.base"],
        "episode_length": len(state),
        "language_goal": instruction,
        "step_lang_goals": subgoals,
        "step_goal_type": types,
    }
    for pos, orn, rel in (("ee_pos", "ee_orn", "rel"), ("base_pos", "base_orn", "base_rel")):
        poses = from_xyzw(values[pos].astype(np.float64), values[orn].astype(np.float64))
        motion = relative_motion(poses)
        values.setdefault(f"{rel}_pos", motion[:, :3, 3])
        values[f"{rel}_orn"] = Rotation.from_matrix(motion[:, :3, :3]).as_quat(canonical=True)
    return {spec.name: spec.cast(values[spec.name]) for spec in EPISODE_INFO if spec.name in values}


def _next(values: NDArray) -> NDArray:
    return np.concatenate([values[1:], values[-1:]])
