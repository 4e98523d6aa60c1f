"""Check ``candidates.h5`` against its schema and list every violation."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.checks import MAX_SEED
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.text import format_count
from robocas_ms3.datasets.checks.violation import Violation, shorten_json
from robocas_ms3.demos.candidates.candidates_file import CandidateFile
from robocas_ms3.demos.candidates.schema import CANDIDATES, DECISIONS, STATES
from robocas_ms3.demos.candidates.tables import FIELDS, Tables
from robocas_ms3.demos.recordings.trajectory_hdf5 import BODIES

Mask = Any  # bool array; in the stubs of NumPy, comparisons of arrays may return scalars
_Rule = tuple[str, str, Mask]  # field, expected value, rows that violate the rule
_LENGTH_TOLERANCE = 1e-3  # of quaternions
_DISTANCE_TOLERANCE = 1e-3  # m, between a displacement and the distance of the recorded positions
_MAX_GRIPPER_WIDTH, _OPENING = 0.2, (-0.1, 1.1)  # m; fraction, with tolerance of the joint limits


@dataclass(frozen=True)
class CandidatesReport:
    """Result of a check of ``candidates.h5``: numbers of checked rows, and all violations."""

    episodes: int
    decisions: int
    candidates: int
    violations: list[Violation]

    def describe_size(self) -> str:
        """Return the numbers of checked rows as text."""
        counts = ((self.episodes, "episode"), (self.decisions, "decision"), (self.candidates, "candidate"))
        return ", ".join(format_count(count, noun) for count, noun in counts)

    def as_json(self) -> dict[str, Any]:
        return {
            "valid": not self.violations,
            "episodes": self.episodes,
            "decisions": self.decisions,
            "candidates": self.candidates,
            "violations": [violation.as_json() for violation in self.violations],
        }


def validate_candidates(path: str | Path, *, on_episode: Callable[[int, int], None] | None = None) -> CandidatesReport:
    """Check a file of candidates against its schema and list all violations.

    There is one violation per rule and field; it names the first row. If an array is missing, or has a wrong type or
    shape, it is the only violation.

    Args:
        path: path of the file.
        on_episode: called once with (episodes, episodes).
    """
    try:
        file = CandidateFile(path, strict=False)
    except DatasetError as error:
        key = str(error.where).removeprefix(f"{path}, ")
        found = ": ".join(filter(None, (error.what, str(error.found))))
        return CandidatesReport(0, 0, 0, [Violation(Path(path).name, key, str(error.expected) or "valid data", found)])
    episodes = len(np.unique(file.decisions["seed"]))
    with np.errstate(invalid="ignore"):  # NaN and infinite values are violations
        violations = _find_violations(file)
    if on_episode:
        on_episode(episodes, episodes)
    return CandidatesReport(episodes, len(file), len(file.candidates["slot"]), violations)


def _find_violations(file: CandidateFile) -> list[Violation]:
    tables = file.tables
    return [
        _make_violation(file.path.name, table, rule, values.get(rule[0]))
        for table, rules, values in (
            (DECISIONS, _check_decisions(tables), tables.decisions),
            (CANDIDATES, _check_candidates(tables), tables.candidates),
            (STATES, _check_states(tables), {}),
        )
        for rule in rules
        if rule[2].any()
    ]


def _make_violation(file: str, table: str, rule: _Rule, values: NDArray[Any] | None) -> Violation:
    name, expected, wrong = rule
    rows = np.flatnonzero(wrong)
    found = "another value" if values is None else shorten_json(values[rows[0]].tolist())
    more = f" (and in {format_count(len(rows) - 1, 'more row')})" if len(rows) > 1 else ""
    return Violation(file, f"{table}/{name}, row {rows[0]}", expected, f"{found}{more}")


def _check_decisions(tables: Tables) -> Iterator[_Rule]:
    values, present = tables.decisions, tables.decisions["present"]
    yield from _check_texts(DECISIONS, values)
    seeds, numbers, steps = values["seed"], values["decision"], values["step"]
    yield "seed", f"0 to {MAX_SEED}", (seeds < 0) | (seeds > MAX_SEED)
    starts = np.append(True, seeds[1:] != seeds[:-1])[: len(seeds)]
    repeated = starts.copy()
    repeated[np.unique(seeds, return_index=True)[1]] = False
    yield "seed", "consecutive decisions per episode", repeated
    previous = np.append(-1, numbers[:-1])[: len(numbers)]
    yield "decision", "0, 1, 2, ... per episode", numbers != np.where(starts, 0, previous + 1)
    yield "step", "at least 0", steps < 0
    yield "attempt", "at least 0", values["attempt"] < 0
    moves = values["moves_left"]
    yield (
        "moves_left",
        "at least 0, or -1 if in_episode is false",
        np.where(values["in_episode"], moves < 0, moves != -1),
    )
    yield "fallen", "false in slots without an object", (values["fallen"] & ~present).any(axis=1)
    yield "instruction", "a text", values["instruction"] == ""
    yield "target_slot", "slot of an object", ~_has_object(values["target_slot"], present)
    for name in ("object_id", "object_name"):
        yield name, "a text for each object", ((values[name] == "") & present).any(axis=1)
    yield from _check_object_poses("object_in_base", values["object_in_base"], present)
    yield (
        "basket_in_base",
        "a pose, or NaN",
        ~(_is_pose(values["basket_in_base"]) | _is_unknown(values["basket_in_base"])),
    )
    yield "tcp_in_base", "a pose", ~_is_pose(values["tcp_in_base"])
    yield "qpos", "finite numbers", ~np.isfinite(values["qpos"]).all(axis=1)
    width = values["gripper_width"]
    yield "gripper_width", f"0 to {_MAX_GRIPPER_WIDTH} m", ~((width >= 0) & (width <= _MAX_GRIPPER_WIDTH))
    held = values["held_slot"]
    yield "held_slot", "slot of an object, or -1", (held != -1) & ~_has_object(held, present)
    yield from _check_measures(values, present)


def _check_candidates(tables: Tables) -> Iterator[_Rule]:
    values, decisions = tables.candidates, tables.decisions
    rows = values["decision_row"]
    present = decisions["present"][rows]
    yield from _check_texts(CANDIDATES, values)
    slot, pulls = values["slot"], values["primitive"] == "pull"
    yield "slot", "slot of an object; -1 for a pull", np.where(pulls, slot != -1, ~_has_object(slot, present))
    feasible, end, final = values["feasible"], values["end_in_base"], values["final_in_base"]
    yield "start_in_base", "a pose", ~_is_pose(values["start_in_base"])
    is_push = values["primitive"] == "push"
    yield "end_in_base", "a pose for a push, else NaN", np.where(is_push, ~_is_pose(end), ~_is_unknown(end))
    yield "final_in_base", "a pose, or NaN", ~(_is_pose(final) | _is_unknown(final))
    chosen = np.bincount(rows[values["chosen"]], minlength=len(decisions["seed"]))
    yield "chosen", "at most one candidate per decision", values["chosen"] & (chosen > 1)[rows]
    yield "chosen", "false if in_episode is false", values["chosen"] & ~decisions["in_episode"][rows]
    yield "success", "feasible candidates only", values["success"] & ~feasible
    yield "failure", "a text if and only if the candidate failed", (values["failure"] == "") != values["success"]
    yield "held", "false for a pull", values["held"] & pulls
    yield "seconds", "finite, at least 0", ~(np.isfinite(values["seconds"]) & (values["seconds"] >= 0))
    yield from _check_object_poses("object_after_in_base", values["object_after_in_base"], present)
    positions = values["object_after_in_base"][..., :3], decisions["object_in_base"][rows][..., :3]
    distance = np.linalg.norm(positions[0].astype(np.float64) - positions[1], axis=-1)
    same = np.isclose(values["displacement"], distance, rtol=1e-3, atol=_DISTANCE_TOLERANCE, equal_nan=True)
    yield "displacement", "the distance of the positions before and after", ~same.all(axis=1)
    for name in ("fallen", "in_basket"):
        yield name, "false in slots without an object", (values[name] & ~present).any(axis=1)
    count = values["disturbed"]
    yield "disturbed", f"0 to {tables.slots}", (count < 0) | (count > tables.slots)
    yield "moves_to_grasp", "at least -1", values["moves_to_grasp"] < -1
    yield from _check_measures(values, present)


def _check_measures(values: dict[str, NDArray[Any]], present: Mask) -> Iterator[_Rule]:
    hidden, opening = values["hidden_fraction"], values["opening"]
    fraction = np.where(present, (hidden >= 0) & (hidden <= 1), np.isnan(hidden))
    yield "hidden_fraction", "0 to 1; NaN in slots without an object", ~fraction.all(axis=1)
    for name in ("obstacles", "free_grasps"):
        counted = np.where(present, values[name] >= 0, values[name] == -1)
        yield name, "at least 0; -1 in slots without an object", ~counted.all(axis=1)
    low, high = _OPENING
    yield "opening", "0 to 1, or NaN", ~(np.isnan(opening) | ((opening >= low) & (opening <= high)))


def _check_object_poses(name: str, poses: NDArray[Any], present: Mask) -> Iterator[_Rule]:
    valid = np.where(present, _is_pose(poses), _is_unknown(poses))
    yield name, "a pose of each object; NaN in slots without an object", ~valid.all(axis=1)


def _check_texts(table: str, values: dict[str, NDArray[Any]]) -> Iterator[_Rule]:
    for field in FIELDS[table]:
        if field.values:
            yield field.name, f"one of {', '.join(field.values)}", ~np.isin(values[field.name], field.values)


def _check_states(tables: Tables) -> Iterator[_Rule]:
    for kind, arrays in tables.states.items():
        for name, rows in arrays.items():
            values = rows.astype(np.float64)
            missing = np.isnan(values).all(axis=1)
            # a body with fewer numbers than in other episodes ends with NaN
            inner = np.isnan(values[:, :-1]) & ~np.isnan(values[:, 1:])
            yield f"{kind}/{name}", "finite numbers", ~missing & (np.isinf(values).any(axis=1) | inner.any(axis=1))
            if kind in BODIES:
                yield f"{kind}/{name}", "numbers that start with a pose", ~missing & ~_is_pose(values[:, :7])


def _has_object(slots: NDArray[Any], present: Mask) -> Mask:
    """Return (N,) bool, whether a slot (N,) has an object."""
    inside = (slots >= 0) & (slots < present.shape[1])
    return inside & np.take_along_axis(present, np.where(inside, slots, 0)[:, None].astype(np.int64), axis=1)[:, 0]


def _is_pose(poses: NDArray[Any]) -> Mask:
    """Return (...) bool, whether poses (..., 7) are finite and have a unit quaternion."""
    if poses.shape[-1] < 7:
        return np.zeros(poses.shape[:-1], bool)
    finite = np.isfinite(poses).all(axis=-1)
    length = np.linalg.norm(np.where(np.isfinite(poses), poses, 0.0)[..., 3:].astype(np.float64), axis=-1)
    return finite & (abs(length - 1) <= _LENGTH_TOLERANCE)


def _is_unknown(poses: NDArray[Any]) -> Mask:
    """Return (...) bool, whether all values of poses (..., 7) are NaN."""
    return np.isnan(poses).all(axis=-1)
