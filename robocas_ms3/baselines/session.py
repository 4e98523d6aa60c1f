"""A run from its beginning to its end, or on from where it was: what `robocas train` does."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from robocas_ms3.baselines.baseline import Baseline, BaselineConfig, OnRead, Samples, Training
from robocas_ms3.baselines.begin import (
    Start,
    config_of,
    facts_of,
    find_start,
    others,
    precision_of,
    threads_of,
    versions,
)
from robocas_ms3.baselines.runs import RUN, DataRecord, RunRecord, hash_of
from robocas_ms3.baselines.table import find_baseline, need_extra
from robocas_ms3.core.errors import EmptySplitError, TrainingError
from robocas_ms3.core.exits import no_exit
from robocas_ms3.core.outputs import FolderKind, OutputFolder
from robocas_ms3.core.strict import parse

OUTPUT = FolderKind("robocas train", (RUN,), "baseline")


@dataclass
class Said:
    """What to call as a training goes on.

    Attributes:
        note: a line for people.
        read: episodes read, and how many will be.
        step: steps done, and all.
    """

    note: Callable[[str], None] = field(default=lambda text: None)
    read: OnRead = field(default=lambda done, of: None)
    step: Callable[[int, int], None] = field(default=lambda done, of: None)


def train_run(
    name: str,
    data: Path | None,
    out: Path,
    changes: Mapping[str, Any] | None = None,
    *,
    start: Path | None = None,
    device: str = "auto",
    overwrite: bool = False,
    said: Said | None = None,
) -> RunRecord:
    """Train a baseline, or continue a run with the same settings.

    Args:
        name: of the baseline.
        data: dataset; None for a baseline that learns by trying.
        out: folder of the run.
        changes: of its configuration, nested as that is; of a run that continues, they may be left out.
        start: folder of a run to begin with, such as one on less data: its weights and scales, and its configuration
            below ``changes``.
        device: ``auto``, ``cpu`` or ``cuda``.
        overwrite: start again, and replace the run in ``out`` once the data is read.
        said: what to call meanwhile.

    Raises:
        TrainingError: the configuration is wrong.
        DatasetError: the data does not suit the baseline.
        OutputExistsError: ``out`` is a run with other settings, versions or data, or no run.
        KeyboardInterrupt: Ctrl-C; the run can be continued.
    """
    need_extra("accelerate", "safetensors", "tensorboard", "transformers")
    baseline, said = find_baseline(name), said or Said()
    trier: Any = baseline if hasattr(baseline, "trials") else None  # a `TrialBaseline`
    _check_data(baseline, data, by_trial=trier is not None)
    output = OutputFolder(out, OUTPUT, overwrite=overwrite)
    is_main = os.environ.get("RANK", "0") == "0"  # of the processes of `accelerate launch`, this one writes
    with ExitStack() as stack:
        stack.enter_context(no_exit(f"baseline {name}"))
        if is_main:
            stack.enter_context(output)
        else:
            output.read()
        output.check_settings({"baseline": baseline.name, "version": baseline.version, "versions": versions()})
        before = None
        if output.recorded is not None:
            before = parse(RunRecord, output.recorded, TrainingError, where=out / RUN)
            config = parse(baseline.Config, before.config, TrainingError, where=out / RUN)
            # Options that are newer than the run have their defaults
            before = before.model_copy(update={"config": config.model_dump(mode="json")})
            output.recorded = before.model_dump(mode="json")
        begin = find_start(baseline, start, before, out)
        config = config_of(baseline, changes, before, begin)
        settings: dict[str, Any] = {"config": config.model_dump(mode="json")}
        output.check_settings(settings | ({"start": begin.name} if begin else {}))
        from robocas_ms3.baselines.devices import make_accelerator
        from robocas_ms3.baselines.train import Trainer

        accelerator = make_accelerator(device, precision_of(config, before))
        if config.train.batch_size % accelerator.num_processes:
            found = f"{config.train.batch_size} for {accelerator.num_processes} processes"
            raise TrainingError("processes share a batch evenly", where="train.batch_size", found=found)
        samples: Any = None
        if trier is not None:
            samples = stack.enter_context(closing(trier.trials(config, accelerator.device.type)))
        hashed = samples.hash if data is None else hash_of(data)
        if before is not None:
            output.check_settings({"data": {**before.data.model_dump(), "hash": hashed}})
        check = None
        if data is not None:
            said.note(f"reading {data}")
            samples = baseline.data(config, data, "train", said.read)
            check = _validation(baseline, config, data, said)
        record = before or _record(baseline, config, data, hashed, samples, begin, accelerator)
        more: dict[str, Any] = {"start": begin.weights if begin else None, "on_note": said.note}
        if trier is not None:
            trainer: Training = trier.training(config, samples, output, record, accelerator, **more)
        else:
            trainer = Trainer(baseline, config, samples, check, output, record, accelerator, **more)
        if before is not None and (changed := others(record, accelerator)):
            record.resumed.append(f"from step {trainer.step} by {changed}")
            said.note(f"continues {record.resumed[-1]}: results differ from those of an uninterrupted run")
        if is_main:
            output.start(record.model_dump(mode="json"))
        accelerator.wait_for_everyone()
        of = f"{len(samples)} {'samples of' if trier is None else 'steps in'} {samples.episodes}"
        said.note(_line(record, trainer, f"{of} {'episodes' if trier is None else 'layouts'}", accelerator))
        trainer.train(said.step)
    return record


def _record(
    baseline: Baseline,
    config: BaselineConfig,
    data: Path | None,
    hashed: str,
    samples: Any,
    begin: Start | None,
    accelerator: Any,
) -> RunRecord:
    """Of a run that begins: see `RunRecord`."""
    return RunRecord(
        baseline=baseline.name,
        version=baseline.version,
        config=config.model_dump(mode="json"),
        facts=facts_of(samples.facts, begin, data),
        data=DataRecord(
            name=samples.name if data is None else data.name,
            hash=hashed,
            episodes=samples.episodes,
            samples=len(samples),
        ),
        versions=versions(),
        device=str(accelerator.device.type),
        precision=str(accelerator.mixed_precision),
        threads=threads_of(accelerator),
        start=begin.name if begin else "",
    )


def _line(record: RunRecord, trainer: Training, of: str, accelerator: Any) -> str:
    """What is trained, on what."""
    count = sum(parameter.numel() for parameter in trainer.parameters())
    precision = "bf16" if accelerator.mixed_precision == "bf16" else "fp32"
    return f"{record.baseline}: {count / 1e6:.2f} M parameters, {of}, {accelerator.device.type}, {precision}"


def _check_data(baseline: Baseline, data: Path | None, *, by_trial: bool) -> None:
    if data is None and not by_trial:
        raise TrainingError(
            f"{baseline.name} learns from data", where="--data", expected="a dataset's folder or a trajectory.h5"
        )
    if data is not None and by_trial:
        raise TrainingError(f"{baseline.name} learns by trying, of no data", where="--data", fix="Leave it out.")


def _validation(baseline: Baseline, config: BaselineConfig, data: Path, said: Said) -> Samples | None:
    try:
        return baseline.data(config, data, "val", said.read)
    except EmptySplitError:
        said.note("no episodes to validate with: there are too few")
        return None
