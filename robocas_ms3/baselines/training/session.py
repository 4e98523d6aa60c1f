"""Start or continue a training run: the work of `robocas train`."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from robocas_ms3.baselines.baseline import Baseline, OnRead, Precision, Progress, Samples, Split
from robocas_ms3.baselines.registry import find_baseline
from robocas_ms3.baselines.training.record import (
    CHECKPOINT,
    RUN,
    WEIGHTS,
    DataRecord,
    RunRecord,
    find_run,
    hash_dataset,
    hash_weights,
    package_versions,
    read_run,
)
from robocas_ms3.core.errors import EmptySplitError, TrainingError, require_extra
from robocas_ms3.core.output_folder import FolderKind, OutputFolder, list_setting_changes
from robocas_ms3.core.signals import forbid_exit
from robocas_ms3.core.strict_model import parse

if TYPE_CHECKING:
    from robocas_ms3.baselines.training.checkpoints import Checkpoint

OUTPUT = FolderKind("robocas train", (RUN,), "baseline")
_INPUTS = ("rate_hz", "image_sizes", "cameras", "calibration", "observed", "acted")
"""Facts that have to be the same in both runs. Others, such as scales, need the same shape."""
_TOLERANCE = 1e-3  # of these: camera poses differ in the last bits


@dataclass(frozen=True)
class RunOptions:
    """What to train, on which data, and where.

    Attributes:
        baseline: its name.
        data: dataset; None for a baseline that learns in simulation.
        out: folder of the run.
        changes: values of the configuration, nested; a run that continues needs none.
        start: folder of a run to start from: its weights, scales and configuration, the latter below ``changes``.
        device: ``auto``, ``cpu`` or ``cuda``.
        overwrite: start again, and replace the run in ``out`` once the data is read.
    """

    baseline: str
    data: Path | None
    out: Path
    changes: Mapping[str, Any] = field(default_factory=dict)
    start: Path | None = None
    device: str = "auto"
    overwrite: bool = False


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


def train_run(options: RunOptions, progress: Progress | None = None) -> RunRecord:
    """Train a baseline, or continue a run with the same settings.

    Raises:
        TrainingError: the configuration is wrong.
        DatasetError: the data does not suit the baseline.
        OutputExistsError: the folder is a run with other settings, versions or data, or no run.
        KeyboardInterrupt: Ctrl-C; the run can be continued.
    """
    require_extra("train", "baselines", "accelerate", "safetensors", "tensorboard", "transformers")
    from robocas_ms3.baselines.training.run_folder import RunFolder, describe_hardware, make_accelerator
    from robocas_ms3.baselines.training.supervised import train_supervised

    baseline: Any = find_baseline(options.baseline)
    progress, data = progress or Progress(), options.data
    _check_data(baseline, data)
    with forbid_exit(f"baseline {options.baseline}"), _open_output(options) as output, ExitStack() as stack:
        recorded = _read_recorded(output, baseline)
        initial = load_initial_weights(baseline, options.start, recorded, options.out)
        base = recorded or (initial.record if initial else None)
        below = base.config if base else baseline.Config().model_dump(mode="json")
        changed = merge_configs(below, options.changes)
        config = parse(baseline.Config, changed, TrainingError, where=baseline.name)
        settings: dict[str, Any] = {"config": config.model_dump(mode="json")}
        output.check_settings(settings | ({"start": initial.name} if initial else {}))
        accelerator = make_accelerator(options.device, _precision(config.train.precision, recorded))
        if config.train.batch_size % accelerator.num_processes:
            found = f"{config.train.batch_size} for {accelerator.num_processes} processes"
            raise TrainingError("processes share a batch evenly", where="train.batch_size", found=found)
        if data is None:
            source = stack.enter_context(closing(baseline.environments(config, accelerator.device.type)))
            name, data_hash = source.name, source.hash
        else:
            name, data_hash = data.name, hash_dataset(data)
        if recorded is not None:
            output.check_settings({"data": {**recorded.data.model_dump(), "hash": data_hash}})
        if data is not None:
            progress.note(f"reading {data}")
            source = baseline.data(config, data, "train", progress.read)
            validation = _read_validation(partial(baseline.data, config, data), progress)
        record = recorded or RunRecord(
            baseline=baseline.name,
            version=baseline.version,
            config=config.model_dump(mode="json"),
            facts=combine_facts(source.facts, initial, data),
            data=DataRecord(name=name, hash=data_hash, episodes=source.episodes, samples=len(source)),
            versions=package_versions(),
            **describe_hardware(accelerator),
            start=initial.name if initial else "",
        )
        run = stack.enter_context(closing(RunFolder(output, record, accelerator, progress)))
        model = _make_model(baseline, config, record, initial).to(accelerator.device)
        if data is None:
            baseline.train(run, model, config, source)
        else:
            train_supervised(run, model, config.train, source, validation)
    return record


def merge_configs(defaults: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return nested mappings with the values of ``changes`` in place of those of ``defaults``."""
    result = dict(defaults)
    for key, value in changes.items():
        inner = result.get(key)
        if isinstance(inner, Mapping) and isinstance(value, Mapping):
            result[key] = merge_configs(inner, value)
        else:
            result[key] = value
    return result


def load_initial_weights(
    baseline: Baseline, start: Path | None, recorded: RunRecord | None, out: Path
) -> InitialWeights | None:
    """Load the weights of the run to start from, if one is named."""
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
    """Return the facts of a run; on a dataset, with initial weights, the other run's, whose scales fit the weights."""
    if initial is None:
        return own
    others = initial.record.facts
    scales = () if data is None else (key for key in own if key in others and key not in _INPUTS)
    for key in (*_INPUTS, *scales):
        tolerance = _TOLERANCE if key in _INPUTS else math.inf
        if changes := list_setting_changes(others.get(key), own.get(key), key, tolerance):
            what, where = f"the run of --start has other {key}", data or initial.name
            fix = "Start from a run with the same inputs, convert the data as for that run, or leave out --start."
            raise TrainingError(what, where=where, found=changes[0], fix=fix)
    return own if data is None else others


def _check_data(baseline: Baseline, data: Path | None) -> None:
    if data is None and baseline.data is not None:
        expected = "a dataset's folder or a trajectory.h5"
        raise TrainingError(f"{baseline.name} needs a dataset", where="--data", expected=expected)
    if data is not None and baseline.data is None:
        raise TrainingError(f"{baseline.name} takes no dataset", where="--data", fix="Leave it out.")


@contextmanager
def _open_output(options: RunOptions) -> Iterator[OutputFolder]:
    """Lock the folder of a run; of several processes only the main one of `accelerate launch`."""
    output = OutputFolder(options.out, OUTPUT, overwrite=options.overwrite)
    if os.environ.get("RANK", "0") == "0":
        with output:
            yield output
    else:
        output.read()
        yield output


def _read_recorded(output: OutputFolder, baseline: Baseline) -> RunRecord | None:
    """Return the record of a run that continues; options that are newer than it have their defaults."""
    output.check_settings({"baseline": baseline.name, "version": baseline.version, "versions": package_versions()})
    if output.recorded is None:
        return None
    where = output.path / RUN
    recorded = parse(RunRecord, output.recorded, TrainingError, where=where)
    config = parse(baseline.Config, recorded.config, TrainingError, where=where)
    recorded = recorded.model_copy(update={"config": config.model_dump(mode="json")})
    output.recorded = recorded.model_dump(mode="json")
    return recorded


def _precision(precision: Precision, recorded: RunRecord | None) -> Precision:
    """Return the precision: a run continues with the one it started with, even if another is fast here."""
    if recorded is None or precision != "auto":
        return precision
    return "bf16" if recorded.precision == "bf16" else "fp32"


def _read_validation(read: Callable[[Split, OnRead], Samples], progress: Progress) -> Samples | None:
    try:
        return read("val", progress.read)
    except EmptySplitError:
        progress.note("no validation: there are too few episodes")
        return None


def _make_model(baseline: Baseline, config: Any, record: RunRecord, initial: InitialWeights | None) -> torch.nn.Module:
    torch.manual_seed(config.train.seed)
    model = baseline.model(config, record.facts)
    if initial is not None and initial.weights is not None:
        initial.weights.load_model(model)
    return model
