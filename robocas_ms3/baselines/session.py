"""A run from its beginning to its end, or on from where it was: what `robocas train` does."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from robocas_ms3.baselines.baseline import Baseline, BaselineConfig, OnRead, Samples, Training
from robocas_ms3.baselines.runs import CHECKPOINT, RUN, WEIGHTS, DataRecord, RunRecord, hash_of, read_run, write_run
from robocas_ms3.baselines.table import find_baseline
from robocas_ms3.errors import DatasetError, TrainingError
from robocas_ms3.files import make_folder
from robocas_ms3.outputs import check_one_way, check_overwrite, check_run, claim_output, locked_folder
from robocas_ms3.strict import parse

_PACKAGES = ("robocas-ms3", "torch", "accelerate", "safetensors", "transformers", "numpy")


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
    resume: bool = False,
    overwrite: bool = False,
    said: Said | None = None,
) -> RunRecord:
    """Train a baseline.

    Args:
        name: of the baseline.
        data: dataset; None for a baseline that learns by trying.
        out: folder of the run.
        changes: of its configuration, nested as that is; for a run that goes on they may be left out.
        start: folder of a run whose weights to begin with, such as one on less data; scales stay those of that run.
        device: ``auto``, ``cpu`` or ``cuda``.
        resume: whether to go on with a run that is there.
        overwrite: whether to replace one.
        said: what to call meanwhile.

    Raises:
        TrainingError: the configuration is wrong, or the run that is there is of something else.
        DatasetError: the data does not suit the baseline.
        OutputExistsError: there is something.
        KeyboardInterrupt: Ctrl-C; ``resume`` goes on.
    """
    check_one_way("train", resume=resume, overwrite=overwrite, error=TrainingError)
    baseline, said = find_baseline(name), said or Said()
    trier: Any = baseline if hasattr(baseline, "trials") else None  # a `TrialBaseline`
    _check_data(baseline, data, by_trial=trier is not None)
    before = read_run(out) if resume and (out / RUN).is_file() else None
    if before is not None:
        _check_kind(before, baseline, out)
    config = _config(baseline, changes, before, out)
    weights, begun_with = _weights(baseline, start, before, out)
    check_run(out / RUN, "baseline", "train")
    from robocas_ms3.baselines.train import Trainer, make_accelerator

    accelerator = make_accelerator(device, config.train.precision)
    with ExitStack() as stack:
        if accelerator.is_main_process:
            stack.enter_context(locked_folder(out))
            if overwrite:
                check_overwrite(out, [RUN], "a run of robocas train")
            claim_output(out, resume=resume or overwrite)  # what is replaced stays until there is something instead
        samples: Any = None
        if trier is not None:
            samples = stack.enter_context(closing(trier.trials(config, accelerator.device.type)))
        hashed = samples.hash if data is None else hash_of(data)
        if before is not None:
            _check_same_data(before, hashed, out)
        check = None
        if data is not None:
            said.note(f"reading {data}")
            samples = baseline.data(config, data, "train", said.read)
            check = _validation(baseline, config, data, said)
        record = before or RunRecord(
            baseline=name,
            version=baseline.version,
            config=config.model_dump(mode="json"),
            facts=samples.facts,
            data=DataRecord(
                name=samples.name if data is None else data.name,
                hash=hashed,
                episodes=samples.episodes,
                samples=len(samples),
            ),
            versions=_versions(),
            device=str(accelerator.device.type),
            precision=str(accelerator.mixed_precision),
            start=begun_with,
        )
        more: dict[str, Any] = {"resume": resume, "start": weights, "on_note": said.note}
        if trier is not None:
            trainer: Training = trier.training(config, samples, out, record, accelerator, **more)
        else:
            trainer = Trainer(baseline, config, samples, check, out, record, accelerator, **more)
        if accelerator.is_main_process and before is None:
            claim_output(out, overwrite=overwrite, resume=True)
            make_folder(out)
            write_run(out, record)
        accelerator.wait_for_everyone()
        count = sum(parameter.numel() for parameter in trainer.parameters())
        of = f"{len(samples)} steps in {samples.episodes} layouts" if trier else ""
        said.note(
            f"{name}: {count / 1e6:.2f} M parameters, "
            f"{of or f'{len(samples)} samples of {samples.episodes} episodes'}, "
            f"{accelerator.device.type}, {'bf16' if accelerator.mixed_precision == 'bf16' else 'fp32'}"
        )
        trainer.train(said.step)
    return record


def _check_data(baseline: Baseline, data: Path | None, *, by_trial: bool) -> None:
    if data is None and not by_trial:
        raise TrainingError("on what?", where="--data", expected="a dataset's folder or a trajectory.h5")
    if data is not None and by_trial:
        raise TrainingError(f"{baseline.name} learns by trying, of no data", where="--data", fix="Leave it out.")


def _config(
    baseline: Baseline, changes: Mapping[str, Any] | None, before: RunRecord | None, out: Path
) -> BaselineConfig:
    if before is None:
        default = baseline.Config().model_dump(mode="json")
        return parse(baseline.Config, merged(default, changes or {}), TrainingError, where=baseline.name)
    config = parse(baseline.Config, before.config, TrainingError, where=out / RUN)
    if changes:
        wanted = parse(baseline.Config, merged(before.config, changes), TrainingError, where=baseline.name)
        if wanted != config:
            fix = "Leave these options out, or train anew with --overwrite."
            raise TrainingError("a run goes on as it was begun", where=out, fix=fix)
    return config


def _weights(
    baseline: Baseline, start: Path | None, before: RunRecord | None, out: Path
) -> tuple[dict[str, Any] | None, str]:
    """Weights of another run that are to begin with, where there are any, and which run that is.

    Raises:
        TrainingError: it is of another baseline or version, or has none; or the run that goes on began with others.
    """
    from robocas_ms3.baselines import checkpoints

    begun = before is not None and (out / CHECKPOINT).is_file()
    if start is None:
        if before is not None and before.start and not begun:
            what = "this run had no checkpoint yet, and begins with another's weights"
            raise TrainingError(what, where=out, expected=before.start, fix="Name that run by --start again.")
        return None, ""
    record = read_run(start)
    name = f"{start.resolve().name}, {record.data.hash}"
    if before is not None and before.start != name:
        fix = "Leave --start out, or train anew with --overwrite."
        raise TrainingError(
            "a run goes on from what it began with",
            where=out,
            expected=before.start or "no --start",
            found=name,
            fix=fix,
        )
    if begun:
        return None, name
    expected = {"baseline": baseline.name, "version": str(baseline.version)}
    weights, _ = checkpoints.load(start / WEIGHTS, expected)
    return weights, name


def _check_kind(before: RunRecord, baseline: Baseline, out: Path) -> None:
    """See that a run is of a baseline, before its configuration is read, which another version may have otherwise."""
    if before.baseline != baseline.name:
        raise TrainingError("a run of another baseline", where=out, expected=baseline.name, found=before.baseline)
    if before.version != baseline.version:
        raise TrainingError(
            f"a run of another version of {baseline.name}",
            where=out,
            expected=baseline.version,
            found=before.version,
            fix="Train anew with --overwrite.",
        )


def _check_same_data(before: RunRecord, hashed: str, out: Path) -> None:
    if before.data.hash != hashed:
        raise TrainingError(
            "a run on another dataset",
            where=out,
            expected=f"{before.data.name}, {before.data.hash[:12]}",
            found=hashed[:12],
            fix="Name that one by --data, or choose another --out.",
        )


def _validation(baseline: Baseline, config: BaselineConfig, data: Path, said: Said) -> Samples | None:
    try:
        return baseline.data(config, data, "val", said.read)
    except DatasetError as error:
        if "split" not in error.what:
            raise
        said.note("no episodes to validate with: there are too few")
        return None


def merged(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """Nested mappings, the second one's values first."""
    result = dict(below)
    for key, value in above.items():
        inner = result.get(key)
        result[key] = merged(inner, value) if isinstance(inner, Mapping) and isinstance(value, Mapping) else value
    return result


def _versions() -> dict[str, str]:
    found = {}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
