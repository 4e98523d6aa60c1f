"""Convert the arrays of an episode to LeRobot features and back."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocas_ms3.core.poses import from_xyzw
from robocas_ms3.datasets.lerobot.schema import ACTION_COLUMNS
from robocas_ms3.datasets.schema import EPISODE_INFO, INTENDED_POSE
from robocas_ms3.demos.recordings.motion import compute_relative_motion
from robocas_ms3.robots.quantities import feature_columns, lerobot_features, to_continuous_xyzw


def to_frame_columns(arrays: dict[str, NDArray]) -> dict[str, NDArray]:
    """Convert the arrays of ``episode_info.npz`` to the numeric LeRobot features (T, D), by key."""
    euler = Rotation.from_quat(arrays["rel_orn"].astype(np.float64)).as_euler("xyz")
    status = arrays["gripper_status"].astype(np.float32)[:, None]
    command = _shift_to_next_step(status)
    goals = arrays.get("intended_joints", arrays["robot_joints"])
    joints = np.concatenate([goals[1:], arrays["robot_joints"][-1:]])
    parts = {
        **{key: [arrays[one.name] for one in quantities] for key, quantities in lerobot_features().items()},
        "action": (arrays["rel_pos"], euler, command),
        "action.joint": (joints, command),
        "action.base": (arrays["rel_agv_pose"],),
    }
    columns = {key: [part.reshape(len(status), -1) for part in of_feature] for key, of_feature in parts.items()}
    return {key: np.concatenate(column, axis=1).astype(np.float32) for key, column in columns.items()}


def to_robocas_arrays(
    columns: dict[str, NDArray],
    instruction: str,
    subgoals: list[str],
    types: list[str],
    *,
    has_action_noise: bool = False,
) -> dict[str, NDArray]:
    """Convert LeRobot features to the arrays of ``episode_info.npz``: the inverse of `to_frame_columns`.

    ``columns`` are the numeric features (T, D), ``subgoals`` and ``types`` the text and type of the sub-goal per step.
    With ``has_action_noise`` the actions lead to the intended poses and joints, which differ from those of the next
    step. Embeddings are missing, because LeRobot datasets do not have them.
    """
    values: dict[str, Any] = {
        "rel_pos": columns["action"][:, ACTION_COLUMNS["rel_pos"]],
        "rel_agv_pose": columns["action.base"],
        "episode_length": len(columns["action"]),
        "language_goal": instruction,
        "step_lang_goals": subgoals,
        "step_goal_type": types,
    }
    for key, quantities in lerobot_features().items():
        column = columns[key].reshape(len(columns["action"]), -1)
        for quantity in quantities:
            part = column[:, feature_columns(key)[quantity.name]].reshape(quantity.shape_for(len(column)))
            values[quantity.name] = part > 0.5 if quantity.dtype == "bool" else part
    intended = None
    if has_action_noise:
        values |= _compute_intended_arrays(values, columns)
        intended = from_xyzw(*(values[key] for key in INTENDED_POSE))
    for pos, orn, rel in (("ee_pos", "ee_orn", "rel"), ("base_pos", "base_orn", "base_rel")):
        poses = from_xyzw(values[pos].astype(np.float64), values[orn].astype(np.float64))
        motion = compute_relative_motion(poses, intended if rel == "rel" else None)
        values.setdefault(f"{rel}_pos", motion[:, :3, 3])
        values[f"{rel}_orn"] = Rotation.from_matrix(motion[:, :3, :3]).as_quat(canonical=True)
    return {spec.name: spec.cast(values[spec.name]) for spec in EPISODE_INFO if spec.name in values}


def _compute_intended_arrays(values: dict[str, Any], columns: dict[str, NDArray]) -> dict[str, NDArray]:
    """Compute the intended pose and joints of each step from the action of the step before."""
    poses = from_xyzw(values["ee_pos"].astype(np.float64), values["ee_orn"].astype(np.float64))
    actions = columns["action"][:-1].astype(np.float64)
    turns = Rotation.from_euler("xyz", actions[:, ACTION_COLUMNS["rel_orn"]]).as_quat()
    motion = from_xyzw(actions[:, ACTION_COLUMNS["rel_pos"]], turns)
    intended = np.concatenate([poses[:1], poses[:-1] @ motion])
    joints = np.concatenate([values["robot_joints"][:1], columns["action.joint"][:-1, :7]])
    arrays = (intended[:, :3, 3], to_continuous_xyzw(intended), joints)
    return dict(zip((*INTENDED_POSE, "intended_joints"), arrays, strict=True))


def _shift_to_next_step(values: NDArray) -> NDArray:
    return np.concatenate([values[1:], values[-1:]])
