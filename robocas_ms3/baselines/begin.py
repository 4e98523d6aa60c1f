"""What a run begins with, or goes on with: its configuration, another run's weights, and what has to be the same."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from robocas_ms3.baselines.baseline import Baseline, BaselineConfig
from robocas_ms3.baselines.runs import CHECKPOINT, WEIGHTS, RunRecord, find_run, hash_of_weights, read_run
from robocas_ms3.core.errors import TrainingError
from robocas_ms3.core.strict import parse

_SEEN = ("rate_hz", "pictures", "cameras", "calibration", "observed", "acted")
"""Facts that a run shares with the one it begins with; others, as scales, only have as many numbers as there."""
_FEW = 8
"""Values of a list that a message has room for."""
_PACKAGES = ("robocas-ms3", "torch", "accelerate", "safetensors", "transformers", "numpy")


@dataclass(frozen=True)
class Start:
    """The run that another one begins with.

    Attributes:
        record: of it.
        name: of its folder, with a hash of its weights.
        weights: its own; None where the other one has a checkpoint already.
    """

    record: RunRecord
    name: str
    weights: dict[str, Any] | None


def find_start(baseline: Baseline, start: Path | None, before: RunRecord | None, out: Path) -> Start | None:
    """The run to begin with, where there is one.

    Raises:
        TrainingError: it is of another baseline or version, or has no weights; or what goes on began with others.
    """
    from robocas_ms3.baselines import checkpoints

    begun = before is not None and (out / CHECKPOINT).is_file()
    if start is None:
        if before is not None and before.start and not begun:
            what = "this run had no checkpoint yet, and begins with another's weights"
            raise TrainingError(what, where=out, expected=before.start, fix="Name that run by --start again.")
        return None
    start = find_run(start)
    record = read_run(start)
    name = f"{start.resolve().name}, {hash_of_weights(start)[:12]}"
    expected = {"baseline": baseline.name, "version": str(baseline.version)}
    return Start(record, name, None if begun else checkpoints.load(start / WEIGHTS, expected)[0])


def config_of(
    baseline: Baseline, changes: Mapping[str, Any] | None, before: RunRecord | None, begin: Start | None
) -> BaselineConfig:
    """Return the recorded configuration, that of the run to start from, or the defaults, with ``changes``.

    Raises:
        TrainingError: it is wrong.
    """
    source = before or (begin.record if begin else None)
    below = source.config if source else baseline.Config().model_dump(mode="json")
    return parse(baseline.Config, merged(below, changes or {}), TrainingError, where=baseline.name)


def precision_of(config: BaselineConfig, before: RunRecord | None) -> Any:
    """A run goes on in what it was begun in, whatever is fast here."""
    if before is None or config.train.precision != "auto":
        return config.train.precision
    return "bf16" if before.precision == "bf16" else "fp32"


def _other(one: Any, other: Any, name: str, tolerance: float) -> tuple[str, Any, Any] | None:
    """Name and values of the first JSON values that differ, numbers by more than a tolerance; None: there are none."""
    if isinstance(one, dict) and isinstance(other, dict) and one.keys() == other.keys():
        found = (_other(one[key], other[key], f"{name}.{key}", tolerance) for key in one)
        return next(filter(None, found), None)
    if isinstance(one, list) and isinstance(other, list):
        if len(one) != len(other):
            shown = max(len(one), len(other)) <= _FEW
            return (name, one, other) if shown else (name, f"{len(one)} values", f"{len(other)} values")
        found = (_other(*pair, f"{name}[{at}]", tolerance) for at, pair in enumerate(zip(one, other, strict=True)))
        return next(filter(None, found), None)
    if isinstance(one, float) and isinstance(other, float):
        return (name, float(f"{one:.4g}"), float(f"{other:.4g}")) if abs(one - other) > tolerance else None
    return (name, one, other) if one != other else None


def facts_of(own: dict[str, Any], begin: Start | None, data: Path | None) -> dict[str, Any]:
    """What a network and its policy know of the data, whose scales are those that its weights were learned by.

    Without data it is what they know of their trials.

    Raises:
        TrainingError: the run that it begins with saw something else.
    """
    if begin is None:
        return own
    scales = () if data is None else (key for key in own if key in begin.record.facts and key not in _SEEN)
    for key in (*_SEEN, *scales):
        # To a thousandth: a camera is not to the bit where it was before.
        tolerance = 1e-3 if key in _SEEN else math.inf
        if (other := _other(begin.record.facts.get(key), own.get(key), key, tolerance)) is not None:
            name, expected, found = other
            raise TrainingError(
                f"--start is of a run with other {key}",
                where=f"{data or begin.name}, {name}",
                expected=expected,
                found=found,
                fix="Begin with a run that saw the same, convert the data as it was for that run, or begin without it.",
            )
    return own if data is None else begin.record.facts


def others(record: RunRecord, accelerator: Any) -> str:
    """By what else than it was begun by a run goes on, which does not give the same to the bit; empty: nothing else."""
    now = {
        "device": str(accelerator.device.type),
        "precision": str(accelerator.mixed_precision),
        "threads": threads_of(accelerator) if record.threads else 0,
    }
    before = {
        "device": record.device,
        "precision": record.precision,
        "threads": record.threads,
    }
    return ", ".join(f"{name} {value}" for name, value in now.items() if before.get(name) != value)


def threads_of(accelerator: Any) -> int:
    """How many add up on a processor; of a GPU 0."""
    import torch

    return torch.get_num_threads() if accelerator.device.type == "cpu" else 0


def merged(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """Nested mappings, the second one's values first."""
    result = dict(below)
    for key, value in above.items():
        inner = result.get(key)
        result[key] = merged(inner, value) if isinstance(inner, Mapping) and isinstance(value, Mapping) else value
    return result


def versions() -> dict[str, str]:
    """Of the packages that results depend on, of those that are installed."""
    found = {}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
