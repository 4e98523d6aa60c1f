"""Weights of another run that a run starts from."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robocas_ms3.baselines.baseline import AnyBaseline
from robocas_ms3.baselines.training.record import CHECKPOINT, WEIGHTS, RunRecord, find_run, hash_weights, read_run
from robocas_ms3.core.errors import TrainingError

if TYPE_CHECKING:
    from robocas_ms3.baselines.training.checkpoints import Checkpoint

_INPUTS = ("rate_hz", "pictures", "cameras", "calibration", "observed", "acted")
"""Facts that have to be the same in both runs. Others, such as scales, need the same shape."""
_TOLERANCE = 1e-3  # of these: camera poses differ in the last bits
_SHOWN = 8  # values of a list in a message


@dataclass(frozen=True)
class InitialWeights:
    """Weights of another run.

    Attributes:
        record: of that run.
        name: of its folder, with a hash of its weights.
        weights: None if the new run has a checkpoint already.
    """

    record: RunRecord
    name: str
    weights: Checkpoint | None


def load_initial_weights(
    baseline: AnyBaseline, start: Path | None, recorded: RunRecord | None, out: Path
) -> InitialWeights | None:
    """Load the weights of the run to start from, if one is named.

    Raises:
        TrainingError: the weights are missing, or of another baseline or version; or a run that continues has no
            checkpoint yet, and the run that it started from is not named.
    """
    from robocas_ms3.baselines.training import checkpoints

    has_checkpoint = recorded is not None and (out / CHECKPOINT).is_file()
    if start is None:
        if recorded is not None and recorded.start and not has_checkpoint:
            what = "this run has no checkpoint yet, and starts from the weights of another"
            raise TrainingError(what, where=out, expected=recorded.start, fix="Name that run by --start again.")
        return None
    start = find_run(start)
    record = read_run(start)
    expected = {"baseline": baseline.name, "version": str(baseline.version)}
    weights = None if has_checkpoint else checkpoints.load(start / WEIGHTS, expected)
    return InitialWeights(record, f"{start.resolve().name}, {hash_weights(start)[:12]}", weights)


def combine_facts(own: dict[str, Any], initial: InitialWeights | None, data: Path | None) -> dict[str, Any]:
    """Return the facts of a run; on a dataset, with initial weights, the other run's, whose scales fit the weights.

    Raises:
        TrainingError: the inputs of the other run differ.
    """
    if initial is None:
        return own
    others = initial.record.facts
    scales = () if data is None else (key for key in own if key in others and key not in _INPUTS)
    for key in (*_INPUTS, *scales):
        tolerance = _TOLERANCE if key in _INPUTS else math.inf
        if (difference := _first_difference(others.get(key), own.get(key), key, tolerance)) is not None:
            name, expected, found = difference
            raise TrainingError(
                f"the run of --start has other {key}",
                where=f"{data or initial.name}, {name}",
                expected=expected,
                found=found,
                fix="Start from a run with the same inputs, convert the data as for that run, or leave out --start.",
            )
    return own if data is None else others


def _first_difference(one: Any, other: Any, name: str, tolerance: float) -> tuple[str, Any, Any] | None:
    """Return name and values of the first JSON values that differ, numbers by more than a tolerance."""
    if isinstance(one, dict) and isinstance(other, dict) and one.keys() == other.keys():
        found = (_first_difference(one[key], other[key], f"{name}.{key}", tolerance) for key in one)
        return next(filter(None, found), None)
    if isinstance(one, list) and isinstance(other, list):
        if len(one) != len(other):
            is_short = max(len(one), len(other)) <= _SHOWN
            return (name, one, other) if is_short else (name, f"{len(one)} values", f"{len(other)} values")
        pairs = enumerate(zip(one, other, strict=True))
        found = (_first_difference(*pair, f"{name}[{index}]", tolerance) for index, pair in pairs)
        return next(filter(None, found), None)
    if isinstance(one, float) and isinstance(other, float):
        return (name, float(f"{one:.4g}"), float(f"{other:.4g}")) if abs(one - other) > tolerance else None
    return (name, one, other) if one != other else None
