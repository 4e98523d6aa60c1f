"""Content of an episode on the page: plots, sub-goals, 3-D paths of the TCP and the objects, facts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocas_ms3.core.poses import from_xyzw
from robocas_ms3.core.text import format_object_name
from robocas_ms3.demos.recordings.subgoals import group_subgoals
from robocas_ms3.robots.quantities import GRIPPER_WIDTH

XYZ = ("x", "y", "z")
ROLL_PITCH_YAW = ("roll", "pitch", "yaw")
ARM = tuple(f"j{i}" for i in range(1, 8))
_OPEN_WIDTH = 0.08  # m
_NEEDED = (
    *("ee_pos", "ee_orn", "base_pos", "base_orn", "rel_pos", "rel_orn", "robot_joints", GRIPPER_WIDTH),
    *("step_goal_type", "step_lang_goals"),
)

Plot = dict[str, Any]


def make_episode_content(
    a: Mapping[str, NDArray],
    scene: Mapping[str, Any],
    *,
    actions: list[Plot] | None = None,
    moving: list[dict[str, Any]] | None = None,
) -> dict[str, Any]:
    """Return the content of the page of an episode, made from its arrays.

    Args:
        a: arrays of the episode by their names in the schema.
        scene: valid values of ``scene.json``.
        actions: plots of recorded actions; None: plots of the motion of the TCP per step.
        moving: objects {name, target, path} with paths (T, 3) in the world frame, or (1, 3) without motion; None: the
            objects at their start positions.

    Raises:
        LookupError: an array is missing.
        ValueError: arrays have different lengths.
    """
    lengths = {len(a[key]) for key in _NEEDED}
    if len(lengths) > 1:
        raise ValueError(f"the arrays of this episode have different lengths: {sorted(lengths)}")
    if actions is None:
        turns = np.degrees(Rotation.from_quat(a["rel_orn"]).as_euler("xyz"))
        actions = [
            make_plot("Action: TCP translation per step", "mm", XYZ, a["rel_pos"] * 1000),
            make_plot("Action: TCP rotation per step", "deg", ROLL_PITCH_YAW, turns),
        ]
    goals = group_subgoals([str(v) for v in a["step_goal_type"]], [str(v) for v in a["step_lang_goals"]])
    base = from_xyzw(a["base_pos"].astype(float), a["base_orn"].astype(float))
    tcp = base @ from_xyzw(a["ee_pos"].astype(float), a["ee_orn"].astype(float))
    objects = _objects(scene) if moving is None else moving
    return {
        "instruction": str(a.get("language_goal", "")),
        "steps": len(a["ee_pos"]),
        "subgoals": [
            {"type": goal.goal_type, "text": goal.goal_description, "first": goal.first, "last": goal.last}
            for goal in goals
        ],
        "plots": [
            make_plot("TCP position, arm base", "m", XYZ, a["ee_pos"]),
            make_plot(
                "TCP orientation, arm base", "quaternion", ("x", "y", "z", "w"), make_signs_continuous(a["ee_orn"])
            ),
            make_plot("Arm joints", "rad", ARM, a["robot_joints"]),
            make_gripper_plot(a[GRIPPER_WIDTH], a.get("gripper_status")),
            *actions,
            *(make_base_plot(a["agv_pose"]) if "agv_pose" in a else []),
        ],
        "trace": {
            "tcp": round_values(tcp[:, :3, 3]),
            "approach": round_values(tcp[:, :3, 2]),
            "objects": [{**thing, "path": round_values(thing["path"])} for thing in objects],
            "moving": moving is not None,
        },
    }


def _objects(scene: Mapping[str, Any]) -> list[dict[str, Any]]:
    layout, target = scene.get("layout") or {}, (scene.get("target") or {}).get("slot")
    names = {thing["slot"]: format_object_name(thing["id"], thing["name"]) for thing in scene.get("objects") or ()}
    found = [
        {"name": names[slot], "target": slot == target, "path": [pose[:3]]}
        for slot, pose in enumerate(layout.get("poses") or ())
        if slot in names
    ]
    basket = layout.get("basket_pose")
    return [*found, {"name": "basket", "target": False, "path": [basket[:3]]}] if basket else found


def collect_facts(scene: Mapping[str, Any]) -> dict[str, Any]:
    """Return values of ``scene.json`` that the page lists below the table, by title."""
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


def make_signs_continuous(xyzw: NDArray) -> NDArray:
    """Flip signs of quaternions (T, 4) xyzw so that consecutive quaternions are close to each other."""
    if len(xyzw) and xyzw[0][np.abs(xyzw[0]).argmax()] < 0:
        xyzw = -xyzw
    flips = np.cumsum(np.sum(xyzw[1:] * xyzw[:-1], axis=1) < 0) % 2
    return np.concatenate([xyzw[:1], xyzw[1:] * np.where(flips, -1, 1)[:, None]])


def make_gripper_plot(width: NDArray, is_open: NDArray | None) -> Plot:
    """Return a plot of the gripper width (T,) in m; ``is_open`` (T,) adds the commanded width."""
    columns: dict[str, NDArray] = {"width": np.ravel(width)}
    if is_open is not None:
        columns["command"] = np.where(np.asarray(is_open, bool), _OPEN_WIDTH, 0.0)
    return make_plot("Gripper", "mm", list(columns), np.column_stack(list(columns.values())) * 1000)


def make_base_plot(pose: NDArray) -> list[Plot]:
    """Return a list with a plot of the base pose (T, 3), x, y in m and yaw in rad; [] if the base does not move."""
    pose = np.column_stack([pose[:, :2], np.unwrap(pose[:, 2])])
    moves = len(pose) > 0 and np.ptp(pose, axis=0).max() > 1e-3
    return [make_plot("Mobile base, world", "m, rad", ("x", "y", "yaw"), pose)] if moves else []


def make_plot(title: str, unit: str, names: Sequence[str], values: NDArray, *, steps: bool = False) -> Plot:
    """Return a plot of N curves from values (T, N); ``steps`` draws the curves as step functions."""
    columns = np.atleast_2d(np.asarray(values, float).T)
    series = [{"name": name, "values": round_values(column)} for name, column in zip(names, columns, strict=True)]
    return {"title": title, "unit": unit, "series": series, "steps": steps}


def round_values(values: Any) -> list:
    """Return numbers as nested lists, rounded; NaN and infinity become None, because JSON has no such numbers."""
    array = np.round(np.asarray(values, float), 5) + 0.0  # + 0.0: no -0.0
    if np.isfinite(array).all():
        return array.tolist()
    known = array.astype(object)
    known[~np.isfinite(array)] = None
    return known.tolist()
