"""Samples and learning rate of a step, as functions of the step alone, so that a run can continue at any step."""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch

from robocas_ms3.baselines.baseline import TrainSettings


class Batches(torch.utils.data.Sampler[list[int]]):
    """Indices of batches, from permutations by (seed, epoch); the rest of an epoch begins the first batch of the next.

    Args:
        count: number of samples, at least 1.
        settings: seed, batch size, number of steps.
        first: step to begin at.
        process: (number, count) of the processes that share each batch.
    """

    def __init__(self, count: int, settings: TrainSettings, first: int = 0, process: tuple[int, int] = (0, 1)) -> None:
        self._count, self._settings, self._first, self._process = count, settings, first, process

    def __len__(self) -> int:
        return self._settings.steps - self._first

    def __iter__(self) -> Iterator[list[int]]:
        size, (number, processes) = self._settings.batch_size, self._process
        epoch, order = -1, torch.empty(0, dtype=torch.int64)
        for step in range(self._first, self._settings.steps):
            indices: list[int] = []
            for place in range(step * size, (step + 1) * size):
                if place // self._count != epoch:
                    epoch = place // self._count
                    order = _permutation(self._count, self._settings.seed, epoch)
                indices.append(int(order[place % self._count]))
            yield indices[number::processes]


def _permutation(count: int, seed: int, epoch: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed((seed * 1_000_003 + epoch) % 2**63)
    return torch.randperm(count, generator=generator)


def epoch_at(step: int, count: int, settings: TrainSettings) -> float:
    """Return how often each of ``count`` samples has been drawn after so many steps."""
    return step * settings.batch_size / count


def learning_rate(step: int, count: int, settings: TrainSettings) -> float:
    """Return the learning rate after ``step`` steps of training on ``count`` samples.

    ``restarts`` is cosine annealing with warm restarts (Loshchilov and Hutter 2017), a period in epochs.
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
