"""Which samples a step is of, and how fast it learns: functions of the step alone, so that runs go on as they were."""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch

from robocas_ms3.baselines.baseline import TrainSettings


class Batches(torch.utils.data.Sampler[list[int]]):
    """Indices of batches: epochs of permutations drawn from (seed, epoch); what is left of an epoch begins the next.

    Args:
        count: samples, at least 1.
        settings: seed, batch size, number of steps.
        first: step to begin at.
        part: (number, of how many) of the processes that share each batch.
    """

    def __init__(self, count: int, settings: TrainSettings, first: int = 0, part: tuple[int, int] = (0, 1)) -> None:
        self._count, self._settings, self._first, self._part = count, settings, first, part

    def __len__(self) -> int:
        return self._settings.steps - self._first

    def __iter__(self) -> Iterator[list[int]]:
        size, (number, of) = self._settings.batch_size, self._part
        epoch, order = -1, torch.empty(0, dtype=torch.int64)
        for step in range(self._first, self._settings.steps):
            taken: list[int] = []
            for place in range(step * size, (step + 1) * size):
                if place // self._count != epoch:
                    epoch = place // self._count
                    order = _permutation(self._count, self._settings.seed, epoch)
                taken.append(int(order[place % self._count]))
            yield taken[number::of]


def _permutation(count: int, seed: int, epoch: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed((seed * 1_000_003 + epoch) % 2**63)
    return torch.randperm(count, generator=generator)


def epochs_at(step: int, count: int, settings: TrainSettings) -> float:
    """How often each of ``count`` samples has been seen after so many steps."""
    return step * settings.batch_size / count


def learning_rate(step: int, count: int, settings: TrainSettings) -> float:
    """Of the step after ``step`` others.

    ``restarts`` is cosine annealing with warm restarts (Loshchilov and Hutter 2017), a period in epochs.
    """
    if step < settings.warmup_steps:
        return settings.learning_rate * (step + 1) / settings.warmup_steps
    if settings.schedule == "constant":
        return settings.learning_rate
    if settings.schedule == "cosine":
        done = (step - settings.warmup_steps) / max(settings.steps - settings.warmup_steps, 1)
    else:
        at, period = epochs_at(step, count, settings), settings.restart_epochs
        while at >= period:
            at, period = at - period, period * settings.restart_factor
        done = at / period
    low = min(settings.min_learning_rate, settings.learning_rate)
    return low + (settings.learning_rate - low) * (1 + math.cos(math.pi * min(done, 1.0))) / 2
