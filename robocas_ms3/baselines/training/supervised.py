"""Supervised training on a CPU, on one GPU, or on several GPUs (``accelerate launch``).

The samples of a batch and the learning rate depend only on the step. Therefore a run can continue at any step.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import Any

import torch
from torch.utils.data import DataLoader

from robocas_ms3.baselines.baseline import Batch, Samples, TrainSettings
from robocas_ms3.baselines.training.learner import Learner
from robocas_ms3.baselines.training.run_folder import RunFolder
from robocas_ms3.core.errors import RobocasError
from robocas_ms3.core.signals import defer_interrupts, make_exit_error
from robocas_ms3.core.text import format_count


def train_supervised(
    run: RunFolder, model: torch.nn.Module, settings: TrainSettings, samples: Samples, validation: Samples | None
) -> None:
    """Train a network up to ``settings.steps``, from the checkpoint of the run if there is one.

    samples: training samples. validation: validation samples; None: no validation.
    """
    accelerator, count = run.accelerator, len(samples)
    learner = Learner(run, model, settings)
    data = f"{format_count(count, 'sample')} of {format_count(samples.episodes, 'episode')}"
    run.start(learner.step, model, learner.policy_weights(), data)

    def log(split: str, metrics: dict[str, float]) -> None:
        rate = learning_rate_at(learner.step - 1, count, settings)
        run.log(learner.step, split, metrics, epoch=epoch_at(learner.step, count, settings), learning_rate=rate)

    def validate() -> None:
        if validation is None or not learner.step:
            return
        if learner.step == settings.steps or learner.step % settings.validate_every == 0:
            metrics = learner.evaluate(_validation_batches(run, validation, settings))
            log("val", metrics)
            text = ", ".join(f"{name} {value:.4g}" for name, value in metrics.items() if math.isfinite(value))
            epoch = epoch_at(learner.step, count, settings)
            run.progress.message(f"step {learner.step}, epoch {epoch:.1f}, validation: {text}")

    run.progress.on_step(learner.step, settings.steps)
    saved_step = learner.step
    try:
        if not run.has_logged(learner.step, "val"):  # interrupted before this validation
            validate()
        rank, world_size = accelerator.process_index, accelerator.num_processes
        indices = batch_indices(count, settings, learner.step, rank, world_size)
        for batch in _read_batches(run, samples, indices, settings.workers):
            with defer_interrupts():  # interrupt only after a complete step
                learner.update(batch, learning_rate_at(learner.step, count, settings))
                is_last = learner.step == settings.steps
                if is_last or learner.step % settings.log_every == 0:
                    log("train", learner.pop_means())
                if is_last or learner.step % settings.save_every == 0:
                    learner.save()
                    saved_step = learner.step
            validate()
            run.progress.on_step(learner.step, settings.steps)
    except KeyboardInterrupt:
        if learner.step > saved_step and accelerator.num_processes == 1:  # several processes may be at different steps
            learner.save()
        raise


def batch_indices(
    count: int, settings: TrainSettings, first_step: int = 0, rank: int = 0, world_size: int = 1
) -> Iterator[list[int]]:
    """Yield the sample indices of each batch of one process, from the first step to the last.

    Each epoch is a random permutation of the samples, which depends on seed and epoch. A batch may contain the end of
    an epoch and the start of the next epoch. The processes share each batch evenly.

    Args:
        count: number of samples, at least 1.
        settings: seed, batch size and number of steps.
        first_step: step of the first batch.
        rank: index of this process.
        world_size: number of processes.
    """
    size = settings.batch_size
    epoch, order = -1, torch.empty(0, dtype=torch.int64)
    for step in range(first_step, settings.steps):
        indices: list[int] = []
        for place in range(step * size, (step + 1) * size):
            if place // count != epoch:
                epoch = place // count
                generator = torch.Generator().manual_seed((settings.seed * 1_000_003 + epoch) % 2**63)
                order = torch.randperm(count, generator=generator)
            indices.append(int(order[place % count]))
        yield indices[rank::world_size]


def epoch_at(step: int, count: int, settings: TrainSettings) -> float:
    """Return the number of epochs after ``step`` training steps, with ``count`` samples per epoch."""
    return step * settings.batch_size / count


def learning_rate_at(step: int, count: int, settings: TrainSettings) -> float:
    """Return the learning rate of the step after ``step`` steps, with ``count`` samples per epoch.

    The schedule ``restarts`` is cosine annealing with warm restarts (Loshchilov and Hutter 2017); its periods are in
    epochs.
    """
    if step < settings.warmup_steps:
        return settings.learning_rate * (step + 1) / settings.warmup_steps
    if settings.schedule == "constant":
        return settings.learning_rate
    if settings.schedule == "cosine":
        fraction = (step - settings.warmup_steps) / max(settings.steps - settings.warmup_steps, 1)
    else:
        epoch, period = epoch_at(step, count, settings), settings.restart_epochs
        while epoch >= period:
            epoch, period = epoch - period, period * settings.restart_factor
        fraction = epoch / period
    low = min(settings.min_learning_rate, settings.learning_rate)
    return low + (settings.learning_rate - low) * (1 + math.cos(math.pi * min(fraction, 1.0))) / 2


def _validation_batches(run: RunFolder, samples: Samples, settings: TrainSettings) -> Iterator[tuple[int, Batch]]:
    """Yield the validation batches of this process, each with its number of samples.

    Every validation has the same batches.
    """
    accelerator = run.accelerator
    count = min(len(samples), settings.validation_samples)
    indices = torch.linspace(0, len(samples) - 1, count).long().tolist()
    if count >= accelerator.num_processes:  # else each process evaluates all samples
        indices = indices[accelerator.process_index :: accelerator.num_processes]
    size = settings.batch_size
    batches = [indices[first : first + size] for first in range(0, len(indices), size)]
    yield from zip(map(len, batches), _read_batches(run, samples, batches, settings.workers), strict=True)


def _read_batches(run: RunFolder, samples: Samples, indices: Iterable[list[int]], workers: int) -> Iterator[Batch]:
    """Yield the batches of samples with these indices, on the device of a run."""
    loader = DataLoader(
        _SamplesWithReturnedErrors(samples),  # pyright: ignore[reportArgumentType]
        batch_sampler=indices,
        collate_fn=_identity,
        num_workers=workers,
        persistent_workers=workers > 0,
        generator=torch.Generator(),  # the loader draws a seed from it, not from the global generator
        multiprocessing_context="forkserver" if workers else None,
    )
    for batch in loader:
        if isinstance(batch, RobocasError):
            raise batch
        yield {name: tensor.to(run.accelerator.device, non_blocking=True) for name, tensor in batch.items()}


class _SamplesWithReturnedErrors:
    """Training samples that return errors instead of raising them.

    `_read_batches` raises the returned errors. An error that a worker process raises would arrive as a traceback text.
    """

    def __init__(self, samples: Samples) -> None:
        self._samples = samples

    def __len__(self) -> int:
        return len(self._samples)

    def __getitems__(self, indices: list[int]) -> Batch | RobocasError:
        try:
            return self._samples.__getitems__(indices)
        except RobocasError as error:
            return error
        except SystemExit as error:  # would end a worker process without a message
            return make_exit_error(error, "samples of the dataset")


def _identity(batch: Any) -> Any:
    return batch
