"""Start or continue a training run: the work of `robocas train`."""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from robocas_ms3.baselines.baseline import Baseline, BaselineConfig, Precision, Progress, RLBaseline, RLConfig, Samples
from robocas_ms3.baselines.registry import find_baseline, need_extra
from robocas_ms3.baselines.training.initial_weights import InitialWeights, combine_facts, load_initial_weights
from robocas_ms3.baselines.training.record import RUN, DataRecord, RunRecord, hash_dataset, package_versions
from robocas_ms3.core.errors import EmptySplitError, TrainingError
from robocas_ms3.core.exits import no_exit
from robocas_ms3.core.outputs import FolderKind, OutputFolder
from robocas_ms3.core.strict import parse

if TYPE_CHECKING:
    from accelerate import Accelerator

OUTPUT = FolderKind("robocas train", (RUN,), "baseline")


def train_run(
    name: str,
    data: Path | None,
    out: Path,
    changes: Mapping[str, Any] | None = None,
    *,
    start: Path | None = None,
    device: str = "auto",
    overwrite: bool = False,
    progress: Progress | None = None,
) -> RunRecord:
    """Train a baseline, or continue a run with the same settings.

    Args:
        name: of the baseline.
        data: dataset; None for a baseline that learns in simulation.
        out: folder of the run.
        changes: values of the configuration, nested; a run that continues needs none.
        start: folder of a run to start from: its weights, scales and configuration, the latter below ``changes``.
        device: ``auto``, ``cpu`` or ``cuda``.
        overwrite: start again, and replace the run in ``out`` once the data is read.
        progress: functions to report to.

    Raises:
        TrainingError: the configuration is wrong.
        DatasetError: the data does not suit the baseline.
        OutputExistsError: ``out`` is a run with other settings, versions or data, or no run.
        KeyboardInterrupt: Ctrl-C; the run can be continued.
    """
    need_extra("accelerate", "safetensors", "tensorboard", "transformers")
    from robocas_ms3.baselines.training.devices import make_accelerator

    baseline, progress = find_baseline(name), progress or Progress()
    _check_data(baseline, data)
    output = OutputFolder(out, OUTPUT, overwrite=overwrite)
    with ExitStack() as stack:
        stack.enter_context(no_exit(f"baseline {name}"))
        if os.environ.get("RANK", "0") == "0":  # the main process of `accelerate launch`
            stack.enter_context(output)
        else:
            output.read()
        recorded = _read_recorded(output, baseline)
        initial = load_initial_weights(baseline, start, recorded, out)
        config = _make_config(baseline, changes, recorded or (initial.record if initial else None))
        settings: dict[str, Any] = {"config": config.model_dump(mode="json")}
        output.check_settings(settings | ({"start": initial.name} if initial else {}))
        accelerator = make_accelerator(device, _precision(config, recorded))
        if config.train.batch_size % accelerator.num_processes:
            found = f"{config.train.batch_size} for {accelerator.num_processes} processes"
            raise TrainingError("processes share a batch evenly", where="train.batch_size", found=found)
        session = _Session(baseline, config, output, accelerator, progress, recorded, initial)
        return session.train_in_simulation() if data is None else session.train_on_data(data)


@dataclass(frozen=True)
class _Session:
    """A run whose folder is locked and whose settings are checked.

    Attributes:
        baseline: to train.
        config: its configuration.
        output: folder of the run.
        accelerator: to train on.
        progress: functions to report to.
        recorded: record of a run that continues.
        initial: weights to start from.
    """

    baseline: Any
    config: Any
    output: OutputFolder
    accelerator: Accelerator
    progress: Progress
    recorded: RunRecord | None
    initial: InitialWeights | None

    def train_on_data(self, data: Path) -> RunRecord:
        """Train on a dataset."""
        from robocas_ms3.baselines.training.run_folder import RunFolder
        from robocas_ms3.baselines.training.supervised import train_supervised

        data_hash = hash_dataset(data)
        self._check_same_data(data_hash)
        self.progress.note(f"reading {data}")
        samples: Samples = self.baseline.data(self.config, data, "train", self.progress.read)
        validation = self._read_validation(data)
        described = DataRecord(name=data.name, hash=data_hash, episodes=samples.episodes, samples=len(samples))
        record = self.recorded or self._make_record(described, combine_facts(samples.facts, self.initial, data))
        with RunFolder(self.output, record, self.accelerator, self.progress) as run:
            train_supervised(run, self._make_model(record), self.config.train, samples, validation)
        return record

    def train_in_simulation(self) -> RunRecord:
        """Train in the environments of the baseline."""
        from robocas_ms3.baselines.training.run_folder import RunFolder

        with closing(self.baseline.environments(self.config, self.accelerator.device.type)) as environments:
            self._check_same_data(environments.hash)
            described = DataRecord(
                name=environments.name,
                hash=environments.hash,
                episodes=environments.episodes,
                samples=len(environments),
            )
            record = self.recorded or self._make_record(
                described, combine_facts(environments.facts, self.initial, None)
            )
            with RunFolder(self.output, record, self.accelerator, self.progress) as run:
                self.baseline.train(run, self._make_model(record), self.config, environments)
        return record

    def _check_same_data(self, data_hash: str) -> None:
        if self.recorded is not None:
            self.output.check_settings({"data": {**self.recorded.data.model_dump(), "hash": data_hash}})

    def _read_validation(self, data: Path) -> Samples | None:
        try:
            return self.baseline.data(self.config, data, "val", self.progress.read)
        except EmptySplitError:
            self.progress.note("no validation: there are too few episodes")
            return None

    def _make_record(self, data: DataRecord, facts: dict[str, Any]) -> RunRecord:
        from robocas_ms3.baselines.training.devices import count_threads

        return RunRecord(
            baseline=self.baseline.name,
            version=self.baseline.version,
            config=self.config.model_dump(mode="json"),
            facts=facts,
            data=data,
            versions=package_versions(),
            device=str(self.accelerator.device.type),
            precision=str(self.accelerator.mixed_precision),
            threads=count_threads(self.accelerator),
            start=self.initial.name if self.initial else "",
        )

    def _make_model(self, record: RunRecord) -> torch.nn.Module:
        """Return the network on the device, with random or initial weights."""
        from robocas_ms3.baselines.training import checkpoints

        torch.manual_seed(self.config.train.seed)
        model = self.baseline.model(self.config, record.facts)
        if self.initial is not None and self.initial.tensors is not None:
            checkpoints.load_weights(model, self.initial.tensors, record.start)
        return model.to(self.accelerator.device)


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


def _check_data(baseline: Baseline | RLBaseline, data: Path | None) -> None:
    needs_data = hasattr(baseline, "data")
    if data is None and needs_data:
        expected = "a dataset's folder or a trajectory.h5"
        raise TrainingError(f"{baseline.name} needs a dataset", where="--data", expected=expected)
    if data is not None and not needs_data:
        raise TrainingError(f"{baseline.name} takes no dataset", where="--data", fix="Leave it out.")


def _read_recorded(output: OutputFolder, baseline: Baseline | RLBaseline) -> RunRecord | None:
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


def _make_config(
    baseline: Baseline | RLBaseline, changes: Mapping[str, Any] | None, base: RunRecord | None
) -> BaselineConfig | RLConfig:
    """Return the configuration of a record, or the defaults, with ``changes``."""
    below = base.config if base else baseline.Config().model_dump(mode="json")
    return parse(baseline.Config, merge_configs(below, changes or {}), TrainingError, where=baseline.name)


def _precision(config: BaselineConfig | RLConfig, recorded: RunRecord | None) -> Precision:
    """Return the precision: a run continues with the one it started with, even if another is fast here."""
    if recorded is None or config.train.precision != "auto":
        return config.train.precision
    return "bf16" if recorded.precision == "bf16" else "fp32"
