"""Metrics of batches and their means: of a batch's samples, or of those that tell something."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch


def mean(counted: torch.Tensor) -> torch.Tensor:
    """Mean () of a sum and over how many it is (2,); of none it is 0."""
    return counted[0] / counted[1].clamp(min=1)


def summed(metric: torch.Tensor, samples: int) -> torch.Tensor:
    """(2,) float64 a sum and over how many it is, of a metric of a batch: its mean (), or already such a pair."""
    metric = metric.detach().double()
    return metric if metric.ndim else torch.stack([metric * samples, torch.full_like(metric, samples)])


def means_of(sums: Mapping[str, torch.Tensor]) -> dict[str, float]:
    """Means by name; NaN of what no sample told."""
    return {name: float(mean(value)) if value[1] else math.nan for name, value in sums.items()}
