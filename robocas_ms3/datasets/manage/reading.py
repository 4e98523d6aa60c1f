"""Reads an episode made elsewhere, and puts right what can be."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.datasets import schema
from robocas_ms3.datasets.checks.rigid import NORM_TOLERANCE, POSITION_TOLERANCE, is_rigid, same
from robocas_ms3.datasets.manage.eef import eef_turn, turn
from robocas_ms3.datasets.manage.findings import Finding, Found, Report
from robocas_ms3.datasets.manage.picture_check import check_pictures
from robocas_ms3.datasets.sources.files import said_of
from robocas_ms3.datasets.sources.reader import Dataset, Episode
from robocas_ms3.datasets.sources.tolerant import SPECS, complete, derive_motion, load_arrays, planar_motion
from robocas_ms3.errors import DatasetError
from robocas_ms3.language.templates import GOAL_TYPES
from robocas_ms3.poses import from_xyzw
from robocas_ms3.recordings.motion import relative_motion

ESSENTIAL = (
    "ee_pos",
    "ee_orn",
    "gripper_status",
    "language_goal",
    "step_lang_goals",
    "step_goal_type",
)
"""Without one of these an episode is of no use; relative motion follows from ee_pos and ee_orn."""


def read_episode(
    dataset: Dataset,
    number: int,
    info: Mapping[str, Any],
    findings: list[Finding],
    *,
    rate_hz: float,
    turn_eef: bool,
    pictures: bool = True,
) -> Found | None:
    """Read an episode, and put right what can be.

    Args:
        dataset: it is in.
        number: of it.
        info: ``data_info.json``.
        findings: what is wrong is added here.
        rate_hz: steps a second.
        turn_eef: where the gripper camera's place says that the EEF frame is turned by a multiple of 90 degrees about
            z, as upstream's is, turn it to ManiSkill's TCP.
        pictures: whether to look at the pictures.

    Returns:
        None where it can't be taken.
    """
    episode = dataset.episode(number)
    report = Report(number, f"{episode.folder.name}/", findings)
    try:
        loaded = load_arrays(episode.folder / schema.EPISODE_FILE)
    except DatasetError as error:
        report.bad(schema.EPISODE_FILE, f"{error.what}{f': {error.found}' if error.found else ''}")
        return None
    said = said_of(info, number)
    complete(loaded, said, rate_hz)
    found = Found(number, loaded.arrays, loaded.derived)
    file = schema.EPISODE_FILE
    for key, reason in loaded.unreadable.items():
        if key in loaded.derived:
            report.mended(f"{file}, {key}", f"{reason}; made of {loaded.derived[key]}")
        elif SPECS[key].embedding:
            report.noted(f"{file}, {key}", f"not taken: {reason}")
        else:
            report.bad(f"{file}, {key}", reason)
    for key in loaded.ignored:
        report.noted(f"{file}, {key}", "an unknown key: not taken")
    for key, source in found.derived.items():
        if key not in loaded.unreadable:
            report.mended(f"{file}, {key}", f"missing; made of {source}")
    for key in ESSENTIAL:
        if key not in found.arrays and key not in loaded.unreadable:
            report.bad(f"{file}, {key}", "missing")
    optional = [spec.name for spec in schema.EPISODE_INFO if not spec.embedding and spec.name not in ESSENTIAL]
    found.missing = [key for key in optional if key not in found.arrays and key not in loaded.unreadable]
    for key in found.missing:
        report.noted(f"{file}, {key}", "missing, and can't be made")
    if report.usable:
        _arrays(found, said, report)
    if report.usable:
        _cameras(episode, found, report, turn_eef)
    if report.usable and pictures:
        found.layout = check_pictures(episode, found.steps, report)
    found.mended = report.mendings
    return found if report.usable else None


def _arrays(found: Found, said: Mapping[str, Any], report: Report) -> None:
    """Lengths, numbers, quaternions, relative motion, texts."""
    arrays, file = found.arrays, schema.EPISODE_FILE
    steps = len(arrays["ee_pos"])
    if found.steps != steps:
        report.mended(f"{file}, episode_length", f"says {found.steps}, the arrays have {steps} steps")
        arrays["episode_length"] = SPECS["episode_length"].cast(steps)
    if not 0 < steps <= schema.MAX_STEPS:
        report.bad(f"{file}, ee_pos", f"{steps} steps, not 1 to {schema.MAX_STEPS}")
        return
    for key in list(arrays):
        spec, array = SPECS[key], arrays[key]
        problem = ""
        if array.shape != spec.shape_for(steps):
            problem = f"shape {array.shape}, not {spec.shape_for(steps)}"
        elif array.dtype.kind == "f" and not np.isfinite(array).all():
            problem = f"{np.sum(~np.isfinite(array))} numbers that are NaN or infinite"
        elif spec.quaternion or spec.embedding:
            off = np.abs(np.linalg.norm(array, axis=-1) - 1).max()
            problem = f"not of unit length: off by {off:.2g}" if off > NORM_TOLERANCE else ""
        if problem and spec.embedding:
            del arrays[key]
            report.noted(f"{file}, {key}", f"not taken: {problem}")
        elif problem:
            report.bad(f"{file}, {key}", problem)
    if not report.usable:
        return
    for keys in schema.RELATIVE_PAIRS:
        if set(keys) <= arrays.keys():
            _motion(arrays, keys, report)
    if {"agv_pose", "rel_agv_pose"} <= arrays.keys():
        motion = planar_motion(arrays["agv_pose"])
        if np.abs(motion - arrays["rel_agv_pose"]).max() > POSITION_TOLERANCE:
            arrays["rel_agv_pose"] = SPECS["rel_agv_pose"].cast(motion)
            report.mended(f"{file}, rel_agv_pose", "not the differences of agv_pose; made of them")
    for kind in sorted(set(arrays["step_goal_type"].tolist()) - set(GOAL_TYPES)):
        report.noted(f"{file}, step_goal_type", f"an unknown type: {kind}")
    if not str(arrays["language_goal"]).strip():
        report.bad(f"{file}, language_goal", "empty")
    for key, value in (("ep_length", steps), ("language_goal", str(arrays["language_goal"]))):
        if key in said and said[key] != value:
            report.mended(f"{file}, {key}", f"{schema.DATA_INFO_FILE} says {said[key]!r}, this {value!r}")


def _motion(arrays: dict[str, NDArray], keys: tuple[str, str, str, str], report: Report) -> None:
    """Relative motion against absolute poses; known conventions are brought to the schema's."""
    position, orientation, rel_position, rel_orientation = keys
    file = f"{schema.EPISODE_FILE}, {rel_position}, {rel_orientation}"

    def poses(order: int) -> tuple[NDArray, NDArray]:
        quaternions = [np.roll(arrays[key], order, axis=1).astype(np.float64) for key in (orientation, rel_orientation)]
        absolute = from_xyzw(arrays[position].astype(np.float64), quaternions[0])
        return relative_motion(absolute), from_xyzw(arrays[rel_position].astype(np.float64), quaternions[1])

    expected, stored = poses(0)
    if _same(expected, stored):
        return
    if _same(*poses(-1)):
        for key in (orientation, rel_orientation):
            arrays[key] = np.ascontiguousarray(np.roll(arrays[key], -1, axis=1))
        report.mended(file, "quaternions were wxyz")
    elif _same(expected[:-1], stored[1:]):
        derive_motion(arrays, keys)
        report.mended(file, "was stored one step later, as the paper writes it")
    elif _same(expected[:-1], stored[:-1]):
        derive_motion(arrays, keys)
        report.mended(file, "the last row was not the identity")
    else:
        wrong = int(np.sum(~same(expected, stored)))
        report.bad(file, f"not the motion of {position}, {orientation}: {wrong} of {len(stored)} rows differ")


def _same(a: NDArray, b: NDArray) -> bool:
    return len(a) > 0 and bool(same(a, b).all())


def _cameras(episode: Episode, found: Found, report: Report, turn_eef: bool) -> None:
    if not episode.cameras:
        report.bad("", "no cameras")
    for camera in episode.cameras:
        try:
            intrinsic, pose = episode.intrinsic(camera), episode.camera_in_parent(camera)
        except DatasetError as error:
            report.bad(camera, f"{error.what}{f': {error.found}' if error.found else ''}")
            continue
        if intrinsic.shape != (4,) or not (np.isfinite(intrinsic).all() and intrinsic.min() > 0):
            report.bad(f"{camera}/{schema.INTRINSIC_FILE}", f"not fx, fy, cx, cy > 0: {intrinsic.tolist()}")
        if not is_rigid(pose):
            report.bad(camera, "its pose is not a rigid transform")
        elif camera == "gripper_camera" and turn_eef:
            found.turn_deg = eef_turn(pose)
    if found.turn_deg and report.usable:
        turn(found.arrays, found.turn_deg)
        file = f"{schema.EPISODE_FILE}, ee_orn, rel_pos, rel_orn"
        report.mended(file, f"EEF frame turned by {found.turn_deg} degrees about z, to be ManiSkill's TCP")
