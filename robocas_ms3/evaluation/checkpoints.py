"""Nested dictionaries of states, such as `SceneEnv.extra_state`, as rows of numbers, for checkpoints."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import torch


def flatten_state(state: Mapping[str, Any]) -> torch.Tensor:
    """Return a state of N envs as rows (N, D) float32, in the order of its entries."""
    return torch.cat([value.reshape(len(value), -1).float() for _, value in _list_entries(state)], dim=1)


def unflatten_state(rows: torch.Tensor, like: Mapping[str, Any]) -> dict[str, Any]:
    """Return the state with rows (N, D) of `flatten_state`; ``like``: a state with the same entries."""
    found, start = {}, 0
    for path, value in _list_entries(like):
        size = value[0].numel()
        part = rows[:, start : start + size].reshape(len(rows), *value.shape[1:]).to(value.dtype)
        start += size
        inner = found
        for key in path[:-1]:
            inner = inner.setdefault(key, {})
        inner[path[-1]] = part
    return found


def _list_entries(
    state: Mapping[str, Any], path: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], torch.Tensor]]:
    """Yield the path of keys and the value of each entry of a nested dictionary."""
    for key, value in state.items():
        if isinstance(value, Mapping):
            yield from _list_entries(value, (*path, key))
        else:
            yield (*path, key), value
