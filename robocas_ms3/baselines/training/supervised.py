"""Supervised training on a CPU, a GPU or several (``accelerate launch``)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import Any

import torch
from accelerate.utils import broadcast_object_list
from torch.utils.data import DataLoader

from robocas_ms3.baselines.baseline import Batch, Samples, TrainSettings
from robocas_ms3.baselines.training.learner import Learner, NotFiniteError
from robocas_ms3.baselines.training.run_folder import RunFolder
from robocas_ms3.baselines.training.schedule import Batches, epoch_at, learning_rate
from robocas_ms3.core.errors import RobocasError
from robocas_ms3.core.exits import deferred_interrupts, exit_error


def train_supervised(
    run: RunFolder, model: torch.nn.Module, settings: TrainSettings, samples: Samples, validation: Samples | None
) -> None:
    """Train a network until all steps are done, from the checkpoint of the run if it has one.

    Args:
        run: folder of the run.
        model: to train, on its device.
        settings: of the training.
        samples: to train on.
        validation: samples to validate on; None: no validation.

    Raises:
        TrainingError: the loss or the gradient is NaN or infinite, or the checkpoint is of something else.
        RobocasError: somebody removed the folder.
        KeyboardInterrupt: Ctrl-C; the steps done are saved, with several processes up to the last checkpoint.
    """
    accelerator = run.accelerator
    checkpoint = run.load_checkpoint()
    learner = Learner(model, settings, accelerator, checkpoint)
    if checkpoint is not None:
        run.repair_weights(learner.step, learner.weights())
    run.start(learner.step, model, f"{len(samples)} samples of {samples.episodes} episodes")

    def log(split: str, metrics: dict[str, float]) -> None:
        epoch = epoch_at(learner.step, len(samples), settings)
        rate = learning_rate(learner.step - 1, len(samples), settings)
        run.log(learner.step, split, metrics, epoch=epoch, learning_rate=rate)

    def validate() -> None:
        if validation is None or not learner.step:
            return
        if learner.step == settings.steps or learner.step % settings.check_every == 0:
            metrics = learner.evaluate(_validation_batches(run, validation, settings))
            log("val", metrics)
            text = ", ".join(f"{name} {value:.4g}" for name, value in metrics.items() if math.isfinite(value))
            epoch = epoch_at(learner.step, len(samples), settings)
            run.progress.note(f"step {learner.step}, epoch {epoch:.1f}, validation: {text}")

    def save() -> None:
        state = learner.state()
        if state is not None:
            run.save(learner.step, state, learner.weights())

    run.progress.step(learner.step, settings.steps)
    saved_step = learner.step
    try:
        (is_validated,) = broadcast_object_list([run.has_logged(learner.step, "val")])
        if not is_validated:  # it was interrupted
            validate()
        process = (accelerator.process_index, accelerator.num_processes)
        batches = Batches(len(samples), settings, learner.step, process)
        for batch in _read_batches(run, samples, batches, settings.workers):
            with deferred_interrupts():  # after a step everything is as a checkpoint has it
                learner.update(batch, learning_rate(learner.step, len(samples), settings))
                is_last = learner.step == settings.steps
                if is_last or learner.step % settings.log_every == 0:
                    log("train", learner.take_means())
                if is_last or learner.step % settings.save_every == 0:
                    save()
                    saved_step = learner.step
            validate()
            run.progress.step(learner.step, settings.steps)
    except NotFiniteError as error:
        raise run.error(str(error), error.step) from error
    except KeyboardInterrupt:
        if learner.step > saved_step and accelerator.num_processes == 1:  # several may be at different steps
            save()
        raise


def _validation_batches(run: RunFolder, samples: Samples, settings: TrainSettings) -> Iterator[tuple[int, Batch]]:
    """Yield this process's batches with their sizes; the same samples at each validation."""
    accelerator = run.accelerator
    count = min(len(samples), settings.check_samples)
    indices = torch.linspace(0, len(samples) - 1, count).long().tolist()
    if count >= accelerator.num_processes:  # else each process takes all
        indices = indices[accelerator.process_index :: accelerator.num_processes]
    size = settings.batch_size
    batches = [indices[first : first + size] for first in range(0, len(indices), size)]
    yield from zip(map(len, batches), _read_batches(run, samples, batches, settings.workers), strict=True)


def _read_batches(run: RunFolder, samples: Samples, indices: Iterable[list[int]], workers: int) -> Iterator[Batch]:
    """Yield the batches of some indices on the device of a run."""
    loader = DataLoader(
        _CaughtErrors(samples),  # pyright: ignore[reportArgumentType]
        batch_sampler=indices,
        collate_fn=_identity,
        num_workers=workers,
        persistent_workers=workers > 0,
        generator=torch.Generator(),  # it draws a seed at the start, which a run that continues does once more
        multiprocessing_context="forkserver" if workers else None,
    )
    for batch in loader:
        if isinstance(batch, RobocasError):
            raise batch
        yield {name: tensor.to(run.accelerator.device, non_blocking=True) for name, tensor in batch.items()}


class _CaughtErrors:
    """Samples that return errors: raised in a worker process, an error would arrive as the text of a traceback."""

    def __init__(self, samples: Samples) -> None:
        self._samples = samples

    def __len__(self) -> int:
        return len(self._samples)

    def __getitems__(self, indices: list[int]) -> Batch | RobocasError:
        try:
            return self._samples.__getitems__(indices)
        except RobocasError as error:
            return error
        except SystemExit as error:  # it would end a worker without a message
            return exit_error(error, "samples of the dataset")


def _identity(batch: Any) -> Any:
    return batch
