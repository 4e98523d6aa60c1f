"""Nested dictionaries of states, such as `SceneEnv.extra_state`, as rows of numbers, for checkpoints."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import torch


def flatten_state(state: Mapping[str, Any]) -> torch.Tensor:
    """Return a state of N envs as rows (N, D) float32, in the order of its entries."""
    return torch.cat([value.reshape(len(value), -1).float() for value in _list_values(state)], dim=1)


def _list_values(state: Mapping[str, Any]) -> Iterator[torch.Tensor]:
    for value in state.values():
        if isinstance(value, Mapping):
            yield from _list_values(value)
        else:
            yield value
