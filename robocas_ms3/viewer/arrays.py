"""An episode of RoboCAS arrays and ``scene.json`` as the page shows it, whichever files they came from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.poses import from_xyzw
from robocas_ms3.core.words import called
from robocas_ms3.demos.recordings.subgoals import SubGoal, subgoal_runs
from robocas_ms3.viewer.parts import plot, rounded
from robocas_ms3.viewer.plots import ROLL_PITCH_YAW, XYZ, base_plot, gripper_plot, motion_plots

NEEDED = (
    *("ee_pos", "ee_orn", "base_pos", "base_orn", "rel_pos", "rel_orn", "robot_joints", "gripper_width"),
    *("step_goal_type", "step_lang_goals"),
)
"""Arrays without which there is nothing to show."""


def show_arrays(a: Mapping[str, NDArray], scene: Mapping[str, Any]) -> dict[str, Any]:
    """Arrays as plots, sub-goals, and the TCP's path among the objects where they stood at the start.

    Args:
        a: arrays by the schema's keys.
        scene: ``scene.json`` without values that are wrong; empty where there is none.

    Raises:
        DatasetError: one is missing.
        ValueError: they contradict each other.
    """
    missing = sorted(set(NEEDED) - set(a))
    if missing:
        found = f"without {', '.join(missing)}"
        raise DatasetError("this episode can't be read", found=found, fix="robocas validate says what is wrong.")
    lengths = {len(a[key]) for key in NEEDED}
    if len(lengths) > 1:
        raise ValueError(f"arrays of different lengths: {sorted(lengths)}")
    turns = np.degrees(Rotation.from_quat(a["rel_orn"]).as_euler("xyz"))
    actions = [
        plot("Action: TCP translation a step", "mm", XYZ, a["rel_pos"] * 1000),
        plot("Action: TCP rotation a step", "deg", ROLL_PITCH_YAW, turns),
    ]
    goals = subgoal_runs([str(v) for v in a["step_goal_type"]], [str(v) for v in a["step_lang_goals"]])
    return show_motion(a, goals, actions, _objects(scene), moving=False)


def show_motion(
    a: Mapping[str, NDArray], goals: Sequence[SubGoal], actions: list[dict], objects: list[dict], *, moving: bool
) -> dict[str, Any]:
    """The same of the arrays that say where the robot was, with what is known from elsewhere.

    Args:
        a: arrays by the schema's keys.
        goals: sub-goals over the steps.
        actions: plots of them.
        objects: {name, target, path}: path in the world (T, 3), or (1, 3) where only its start is known or it stands.
        moving: whether the objects' motion is known.
    """
    base = from_xyzw(a["base_pos"].astype(float), a["base_orn"].astype(float))
    tcp = base @ from_xyzw(a["ee_pos"].astype(float), a["ee_orn"].astype(float))
    is_open = a.get("gripper_status")
    return {
        "instruction": str(a.get("language_goal", "")),
        "steps": len(a["ee_pos"]),
        "subgoals": [_goal(goal) for goal in goals],
        "plots": [
            *motion_plots(a["ee_pos"], a["ee_orn"], a["robot_joints"]),
            gripper_plot(a["gripper_width"], None if is_open is None else np.asarray(is_open, bool)),
            *actions,
            *(base_plot(a["agv_pose"]) if "agv_pose" in a else []),
        ],
        "trace": {
            "tcp": rounded(tcp[:, :3, 3]),
            "approach": rounded(tcp[:, :3, 2]),
            "objects": [{**thing, "path": rounded(thing["path"])} for thing in objects],
            "moving": moving,
        },
    }


def _goal(goal: SubGoal) -> dict[str, Any]:
    return {"type": goal.goal_type, "text": goal.goal_description, "first": goal.first, "last": goal.last}


def _objects(scene: Mapping[str, Any]) -> list[dict[str, Any]]:
    layout, target = scene.get("layout") or {}, (scene.get("target") or {}).get("slot")
    names = {thing["slot"]: called(thing["id"], thing["name"]) for thing in scene.get("objects") or ()}
    poses = layout.get("poses") or ()
    found = [
        {"name": names[slot], "target": slot == target, "path": [pose[:3]]}
        for slot, pose in enumerate(poses)
        if slot in names
    ]
    basket = layout.get("basket_pose")
    return [*found, {"name": "basket", "target": False, "path": [basket[:3]]}] if basket else found


def facts_of(scene: Mapping[str, Any]) -> dict[str, Any]:
    """What people may want to know of an episode beside its table row."""
    recorded, source = scene.get("recorded") or {}, scene.get("source") or {}
    recording = f"{source['trajectory']}, episode {source.get('episode_id')}" if source.get("trajectory") else None
    kwargs = (scene.get("env_info") or {}).get("env_kwargs") or {}
    config = kwargs.get("config")
    return {
        "Configuration": config if isinstance(config, str) else None,
        "Object pack": kwargs.get("pack"),
        "Recorded with": scene.get("control_mode"),
        "Recording": recording,
        "Relation": recorded.get("relation"),
        **{str(name).capitalize(): value for name, value in (recorded.get("facts") or {}).items()},
    }
