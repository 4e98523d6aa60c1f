"""Which violation of an episode's arrays has which mend: what can't be mended leaves the episode out, or is noted."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.words import count_of
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.checks import arrays as laws
from robocas_ms3.datasets.checks.rigid import same
from robocas_ms3.datasets.checks.violation import Violation
from robocas_ms3.datasets.manage.findings import EMBEDDINGS, ESSENTIAL, Finding, Outcome
from robocas_ms3.datasets.sources.tolerant import SPECS, EpisodeArrays, motion_arrays, planar_motion

Treatment = tuple[EpisodeArrays, Outcome, str]
"""The arrays after it, what becomes of the episode, and the problem in words."""
Mend = Callable[[EpisodeArrays, Violation], Treatment]
Keys = tuple[str, str, str, str]
"""One of ``schema.RELATIVE_PAIRS``."""


def mend_all(stored: EpisodeArrays) -> tuple[EpisodeArrays, list[Finding]]:
    """Mend what can be mended; where something leaves the episode out, what builds on it is not looked at."""
    findings: list[Finding] = []
    for stage in MENDS:
        for check, mend in stage.items():
            for violation in list(check(stored)):
                stored, outcome, problem = mend(stored, violation)
                findings.append(finding(stored, violation.key, outcome, problem))
        if any(found.outcome == "left out" for found in findings):
            break
    return stored, findings


def finding(stored: EpisodeArrays, key: str, outcome: Outcome, problem: str) -> Finding:
    """A finding about an array."""
    return Finding(schema.episode_number(stored.path.parent.name), f"{stored.file}, {key}", problem, outcome)


def key_findings(loaded: EpisodeArrays, made: EpisodeArrays) -> Iterator[Finding]:
    """What becomes of keys that are missing, unreadable or unknown; ``made`` is what was loaded, completed."""
    for key in (*loaded.unreadable, *(violation.key for violation in laws.check_keys(loaded))):
        why = loaded.reason(key) if key in loaded.unreadable else "missing"
        if key not in SPECS:
            yield finding(loaded, key, "noted", "an unknown key: not taken")
        elif key in made.derived:
            yield finding(loaded, key, "mended", f"{why}; made of {made.derived[key]}")
        elif key in EMBEDDINGS:
            yield finding(loaded, key, "noted", f"not taken: {why}")
        elif key in loaded.unreadable or key in ESSENTIAL:
            yield finding(loaded, key, "left out", why)
        else:
            yield finding(loaded, key, "noted", "missing, and can't be made")


def check_pairs(stored: EpisodeArrays) -> Iterator[Violation]:
    """As `laws.check_motion`, one violation a pair."""
    for keys in schema.RELATIVE_PAIRS:
        if any(laws.check_pair(stored, keys)):
            rows = same(*laws.motion_of(stored, keys))
            found = f"{int(np.sum(~rows))} of {len(rows)} rows differ"
            yield Violation(stored.file, ", ".join(keys[2:]), f"the motion of {', '.join(keys[:2])}", found)


def _mend_shape(stored: EpisodeArrays, violation: Violation) -> Treatment:
    if violation.key != "episode_length":
        return _drop(stored, violation, f"{violation.found}, not {violation.expected.removeprefix('shape ')}")
    if not 0 < stored.steps <= schema.MAX_STEPS:
        return stored, "left out", f"{count_of(stored.steps, 'step')}, not 1 to {schema.MAX_STEPS}"
    length = SPECS["episode_length"].cast(stored.steps)
    problem = f"says {violation.found}, the arrays have {count_of(stored.steps, 'step')}"
    return _with(stored, {"episode_length": length}), "mended", problem


def _mend_nan(stored: EpisodeArrays, violation: Violation) -> Treatment:
    return _drop(stored, violation, violation.found.replace("others", "numbers that are NaN or infinite"))


def _mend_unit(stored: EpisodeArrays, violation: Violation) -> Treatment:
    return _drop(stored, violation, f"not of unit length: {violation.found.partition(' in row')[0]}")


def _mend_motion(stored: EpisodeArrays, violation: Violation) -> Treatment:
    """Relative motion of a known convention is brought to the schema's: that which has no violation as such."""
    keys = next(keys for keys in schema.RELATIVE_PAIRS if violation.key == ", ".join(keys[2:]))
    for problem, convention, mended in CONVENTIONS:
        if not any(laws.check_pair(_with(stored, convention(stored.arrays, keys)), keys)):
            return _with(stored, mended(stored.arrays, keys)), "mended", problem
    return stored, "left out", f"not {violation.expected}: {violation.found}"


def _mend_base_motion(stored: EpisodeArrays, violation: Violation) -> Treatment:
    motion = SPECS[violation.key].cast(planar_motion(stored.arrays["agv_pose"]))
    return _with(stored, {violation.key: motion}), "mended", "not the differences of agv_pose; made of them"


def _mend_value(stored: EpisodeArrays, violation: Violation) -> Treatment:
    if violation.key == "language_goal":
        return stored, "left out", "empty"
    return stored, "noted", f"{violation.found}, not {violation.expected}"


def _drop(stored: EpisodeArrays, violation: Violation, problem: str) -> Treatment:
    """Embeddings are dropped: an episode can do without, and without no other array."""
    if violation.key not in EMBEDDINGS:
        return stored, "left out", problem
    arrays = {key: array for key, array in stored.arrays.items() if key != violation.key}
    return replace(stored, arrays=arrays), "noted", f"not taken: {problem}"


def _with(stored: EpisodeArrays, arrays: Mapping[str, NDArray]) -> EpisodeArrays:
    return replace(stored, arrays={**stored.arrays, **arrays})


def _from_wxyz(arrays: Mapping[str, NDArray], keys: Keys) -> dict[str, NDArray]:
    return {key: np.ascontiguousarray(np.roll(arrays[key], -1, axis=1)) for key in (keys[1], keys[3])}


def _from_a_step_later(arrays: Mapping[str, NDArray], keys: Keys) -> dict[str, NDArray]:
    return _still_at_last({key: np.roll(arrays[key], -1, axis=0) for key in keys[2:]}, keys)


def _still_at_last(arrays: Mapping[str, NDArray], keys: Keys) -> dict[str, NDArray]:
    last = {keys[2]: [0, 0, 0], keys[3]: [0, 0, 0, 1]}
    return {key: np.vstack([arrays[key][:-1], row]).astype(arrays[key].dtype) for key, row in last.items()}


CONVENTIONS = (
    ("quaternions were wxyz", _from_wxyz, _from_wxyz),
    ("was stored one step later, as the paper writes it", _from_a_step_later, motion_arrays),
    ("the last row was not the identity", _still_at_last, motion_arrays),
)
"""In words; what relative motion would be if it were of this convention; what it is mended to."""

MENDS: tuple[dict[laws.Check, Mend], ...] = (
    {laws.check_shapes: _mend_shape, laws.check_finite: _mend_nan},
    {laws.check_units: _mend_unit},
    {check_pairs: _mend_motion, laws.check_base_motion: _mend_base_motion, laws.check_values: _mend_value},
)
"""In stages, each of which builds on the one before."""
