"""An episode of RoboCAS arrays and ``scene.json`` as the page shows it, whichever files they came from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocas_ms3.demos.ledger import Failure
from robocas_ms3.poses import from_xyzw
from robocas_ms3.recordings.subgoals import subgoal_runs
from robocas_ms3.viewer.failures import describe
from robocas_ms3.viewer.plots import ROLL_PITCH_YAW, XYZ, base_plot, gripper_plot, motion_plots
from robocas_ms3.viewer.source import make_episode, make_trace, plot

NEEDED = (
    *("ee_pos", "ee_orn", "base_pos", "base_orn", "rel_pos", "rel_orn", "robot_joints", "gripper_width"),
    *("step_goal_type", "step_lang_goals"),
)
"""Arrays without which there is nothing to show."""


def show_arrays(
    number: int,
    a: Mapping[str, NDArray],
    scene: Mapping[str, Any],
    rate_hz: float,
    failures: Sequence[Failure] = (),
) -> dict[str, Any]:
    """Arrays as plots, sub-goals, and the TCP's path among the objects where they stood at the start.

    Args:
        number: of the episode.
        a: arrays by the schema's keys; all of `NEEDED`.
        scene: ``scene.json`` without values that are wrong; empty where there is none.
        rate_hz: steps a second.
        failures: known of its seed.

    Raises:
        ValueError: they contradict each other.
    """
    lengths = {len(a[key]) for key in NEEDED}
    if len(lengths) > 1:
        raise ValueError(f"arrays of different lengths: {sorted(lengths)}")
    recorded = scene.get("recorded") or {}
    turns = np.degrees(Rotation.from_quat(a["rel_orn"]).as_euler("xyz"))
    goals = subgoal_runs([str(v) for v in a["step_goal_type"]], [str(v) for v in a["step_lang_goals"]])
    base = from_xyzw(a["base_pos"].astype(float), a["base_orn"].astype(float))
    tcp = base @ from_xyzw(a["ee_pos"].astype(float), a["ee_orn"].astype(float))
    is_open = a.get("gripper_status")
    return make_episode(
        number,
        instruction=str(a.get("language_goal", "")),
        steps=len(a["ee_pos"]),
        rate_hz=rate_hz,
        subgoals=[{"type": g.goal_type, "text": g.goal_description, "first": g.first, "last": g.last} for g in goals],
        plots=[
            *motion_plots(a["ee_pos"], a["ee_orn"], a["robot_joints"]),
            gripper_plot(a["gripper_width"], None if is_open is None else np.asarray(is_open, bool)),
            plot("Action: TCP translation a step", "mm", XYZ, a["rel_pos"] * 1000),
            plot("Action: TCP rotation a step", "deg", ROLL_PITCH_YAW, turns),
            *(base_plot(a["agv_pose"]) if "agv_pose" in a else []),
        ],
        trace=make_trace(tcp, _objects(scene), moving=False),
        facts=_facts(scene, recorded),
        failures=describe(failures, recorded),
    )


def _objects(scene: Mapping[str, Any]) -> list[dict[str, Any]]:
    layout, target = scene.get("layout") or {}, (scene.get("target") or {}).get("slot")
    names = {thing["slot"]: thing["name"] for thing in scene.get("objects") or ()}
    poses = layout.get("poses") or ()
    found = [
        {"name": names[slot], "target": slot == target, "path": [pose[:3]]}
        for slot, pose in enumerate(poses)
        if slot in names
    ]
    basket = layout.get("basket_pose")
    return [*found, {"name": "basket", "target": False, "path": [basket[:3]]}] if basket else found


def _facts(scene: Mapping[str, Any], recorded: Mapping[str, Any]) -> dict[str, Any]:
    source = scene.get("source") or {}
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
