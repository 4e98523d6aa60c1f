"""Repairs of the arrays of an episode in the format of RoboCAS-v0; what can't be repaired leaves the episode out."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocas_ms3.core.words import count_of
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.checks import arrays as laws
from robocas_ms3.datasets.checks.violation import Violation
from robocas_ms3.datasets.sources.tolerant import SPECS, EpisodeArrays, motion_arrays
from robocas_ms3.demos.recordings.motion import planar_motion
from robocas_ms3.robots.quantities import continuous_xyzw

EMBEDDINGS = tuple(spec.name for spec in schema.EPISODE_INFO if spec.embedding)
_ESSENTIAL = ("ee_pos", "ee_orn", "gripper_status", "language_goal", "step_lang_goals", "step_goal_type")
_CAMERA_OFFSET = (0.03, 0.07)  # m: the gripper camera is 0.05 m from the axis of the hand

Outcome = Literal["left out", "mended", "noted"]
"""The episode is skipped; the fault is repaired; the episode is taken with the fault."""
Repair = Callable[[EpisodeArrays, Violation], tuple[EpisodeArrays, Outcome, str]]
"""Returns the arrays, the outcome, and a description of the fault."""
Keys = tuple[str, str, str, str]
"""One of ``schema.RELATIVE_PAIRS``."""


@dataclass(frozen=True)
class Finding:
    """A difference from the schema.

    Attributes:
        episode: its number; None: a difference of the dataset.
        file: path in the dataset, key after a comma.
        problem: what is wrong.
        outcome: what the import does about it.
    """

    episode: int | None
    file: str
    problem: str
    outcome: Outcome


def finding(stored: EpisodeArrays, key: str, outcome: Outcome, problem: str) -> Finding:
    """Return a finding about an array."""
    return Finding(schema.episode_number(stored.path.parent.name), f"{stored.file}, {key}", problem, outcome)


def repair_arrays(stored: EpisodeArrays) -> tuple[EpisodeArrays, list[Finding]]:
    """Return the repaired arrays and what was found; later stages are skipped once the episode is left out."""
    findings: list[Finding] = []
    for stage in _REPAIRS:
        for check, repair in stage.items():
            for violation in list(check(stored)):
                stored, outcome, problem = repair(stored, violation)
                findings.append(finding(stored, violation.key, outcome, problem))
        if any(found.outcome == "left out" for found in findings):
            break
    return stored, findings


def key_findings(loaded: EpisodeArrays, made: EpisodeArrays) -> Iterator[Finding]:
    """Yield findings about missing, unreadable and unknown keys; ``made`` is ``loaded``, completed."""
    for key in (*loaded.unreadable, *(violation.key for violation in laws.check_keys(loaded))):
        why = loaded.reason(key) if key in loaded.unreadable else "missing"
        if key not in SPECS:
            yield finding(loaded, key, "noted", "an unknown key: not taken")
        elif key in made.derived:
            yield finding(loaded, key, "mended", f"{why}; made of {made.derived[key]}")
        elif key in EMBEDDINGS:
            yield finding(loaded, key, "noted", f"not taken: {why}")
        elif key in loaded.unreadable or key in _ESSENTIAL:
            yield finding(loaded, key, "left out", why)
        else:
            yield finding(loaded, key, "noted", "missing, and can't be made")


def eef_turn(camera_in_ee: NDArray) -> int:
    """Return the turn about z from an EEF frame to the TCP of ManiSkill: 0, 90, 180 or -90 degrees.

    The gripper camera is 0.05 m from the axis of the hand, on the x side of ManiSkill's TCP; RoboCAS-v0 has a frame
    turned by -90 degrees. If the camera is elsewhere, the frame stays.
    """
    x, y = camera_in_ee[:2, 3]
    if not _CAMERA_OFFSET[0] < np.hypot(x, y) < _CAMERA_OFFSET[1]:
        return 0
    angle = np.rad2deg(np.arctan2(y, x))
    quarter = round(angle / 90)
    return (quarter % 4 if quarter % 4 != 3 else -1) * 90 if abs(angle - quarter * 90) < 5 else 0


def about_z(degrees: float) -> NDArray[np.float64]:
    """Return a turn about z, (4, 4)."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    return matrix


def turn_eef_frame(stored: EpisodeArrays, degrees: float) -> EpisodeArrays:
    """Turn the EEF frame about its own z."""
    turns = Rotation.from_quat(stored.arrays["ee_orn"]) * Rotation.from_euler("z", degrees, degrees=True)
    arrays = {**stored.arrays, "ee_orn": SPECS["ee_orn"].cast(continuous_xyzw(turns.as_matrix()))}
    return replace(stored, arrays={**arrays, **motion_arrays(arrays, schema.RELATIVE_PAIRS[0])})


def _repair_shape(stored: EpisodeArrays, violation: Violation) -> tuple[EpisodeArrays, Outcome, str]:
    if violation.key != "episode_length":
        return _drop(stored, violation, f"{violation.found}, not {violation.expected.removeprefix('shape ')}")
    if not 0 < stored.steps <= schema.MAX_STEPS:
        return stored, "left out", f"{count_of(stored.steps, 'step')}, not 1 to {schema.MAX_STEPS}"
    length = SPECS["episode_length"].cast(stored.steps)
    problem = f"says {violation.found}, the arrays have {count_of(stored.steps, 'step')}"
    return _with(stored, {"episode_length": length}), "mended", problem


def _repair_nan(stored: EpisodeArrays, violation: Violation) -> tuple[EpisodeArrays, Outcome, str]:
    return _drop(stored, violation, violation.found.replace("others", "numbers that are NaN or infinite"))


def _repair_unit(stored: EpisodeArrays, violation: Violation) -> tuple[EpisodeArrays, Outcome, str]:
    return _drop(stored, violation, f"not of unit length: {violation.found.partition(' in row')[0]}")


def _drop(stored: EpisodeArrays, violation: Violation, problem: str) -> tuple[EpisodeArrays, Outcome, str]:
    """Drop an embedding; without any other array the episode is left out."""
    if violation.key not in EMBEDDINGS:
        return stored, "left out", problem
    arrays = {key: array for key, array in stored.arrays.items() if key != violation.key}
    return replace(stored, arrays=arrays), "noted", f"not taken: {problem}"


def _check_pairs(stored: EpisodeArrays) -> Iterator[Violation]:
    """Check as `laws.check_motion`, with one violation per pair."""
    for keys in schema.RELATIVE_PAIRS:
        if any(laws.check_pair(stored, keys)):
            rows = laws.wrong_rows(stored, keys)
            found = f"{int(np.sum(rows))} of {len(rows)} rows differ"
            yield Violation(stored.file, ", ".join(keys[2:]), f"the motion of {', '.join(keys[:2])}", found)


def _repair_motion(stored: EpisodeArrays, violation: Violation) -> tuple[EpisodeArrays, Outcome, str]:
    """Convert relative motion from the convention by which it agrees with the poses."""
    keys = next(keys for keys in schema.RELATIVE_PAIRS if violation.key == ", ".join(keys[2:]))
    for problem, converted, repaired in _CONVENTIONS:
        if not any(laws.check_pair(_with(stored, converted(stored.arrays, keys)), keys)):
            return _with(stored, repaired(stored.arrays, keys)), "mended", problem
    return stored, "left out", f"not {violation.expected}: {violation.found}"


def _repair_base_motion(stored: EpisodeArrays, violation: Violation) -> tuple[EpisodeArrays, Outcome, str]:
    motion = SPECS[violation.key].cast(planar_motion(stored.arrays["agv_pose"]))
    return _with(stored, {violation.key: motion}), "mended", "not the differences of agv_pose; made of them"


def _repair_value(stored: EpisodeArrays, violation: Violation) -> tuple[EpisodeArrays, Outcome, str]:
    if violation.key == "language_goal":
        return stored, "left out", "empty"
    return stored, "noted", f"{violation.found}, not {violation.expected}"


def _with(stored: EpisodeArrays, arrays: Mapping[str, NDArray]) -> EpisodeArrays:
    return replace(stored, arrays={**stored.arrays, **arrays})


def _from_wxyz(arrays: Mapping[str, NDArray], keys: Keys) -> dict[str, NDArray]:
    return {key: np.ascontiguousarray(np.roll(arrays[key], -1, axis=1)) for key in (keys[1], keys[3])}


def _from_a_step_later(arrays: Mapping[str, NDArray], keys: Keys) -> dict[str, NDArray]:
    return _with_identity_last({key: np.roll(arrays[key], -1, axis=0) for key in keys[2:]}, keys)


def _with_identity_last(arrays: Mapping[str, NDArray], keys: Keys) -> dict[str, NDArray]:
    last = {keys[2]: [0, 0, 0], keys[3]: [0, 0, 0, 1]}
    return {key: np.vstack([arrays[key][:-1], row]).astype(arrays[key].dtype) for key, row in last.items()}


_CONVENTIONS = (  # description, conversion to compare with the poses, repair
    ("quaternions were wxyz", _from_wxyz, _from_wxyz),
    ("was stored one step later, as the paper writes it", _from_a_step_later, motion_arrays),
    ("the last row was not the identity", _with_identity_last, motion_arrays),
)
_REPAIRS: tuple[dict[laws.Check, Repair], ...] = (  # each stage needs the one before
    {laws.check_shapes: _repair_shape, laws.check_finite: _repair_nan},
    {laws.check_units: _repair_unit},
    {_check_pairs: _repair_motion, laws.check_base_motion: _repair_base_motion, laws.check_values: _repair_value},
)
