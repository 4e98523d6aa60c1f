"""Batched arrays: tensors on a GPU, NumPy's on a CPU, where small operations of theirs cost a third."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
import torch
from torch import Tensor

# `Tensor` or `NDArray`, all of a call of the same kind; type checkers can't follow that through operators
Array: TypeAlias = Any


def native(tensor: Tensor) -> Any:
    """A tensor as the kind of array that is fast where it lies: on a CPU NumPy's, which shares its memory."""
    return tensor if tensor.is_cuda else tensor.numpy()


def as_tensor(array: Any) -> Tensor:
    """An array as a tensor, which shares its memory."""
    return array if isinstance(array, Tensor) else torch.from_numpy(array)


def choose(condition: Array, yes: Array, no: Array) -> Array:
    """``yes`` where the condition holds, ``no`` elsewhere."""
    return torch.where(condition, yes, no) if isinstance(condition, Tensor) else np.where(condition, yes, no)


def as_float(values: Array) -> Array:
    """Flags or numbers as float32."""
    return values.float() if isinstance(values, Tensor) else np.asarray(values, np.float32)


def as_double(values: Array) -> Array:
    """Return numbers as float64."""
    return values.double() if isinstance(values, Tensor) else np.asarray(values, np.float64)


def clamp(values: Array, low: Any, high: Any) -> Array:
    """Values within limits, which are numbers or arrays of the same kind."""
    if isinstance(values, Tensor):
        return values.clamp(low, high)
    return np.minimum(np.maximum(values, low), high)  # `np.clip` takes three times as long


def greater(one: Array, other: Array) -> Array:
    """The greater of each two numbers."""
    return torch.maximum(one, other) if isinstance(one, Tensor) else np.maximum(one, other)


def join(arrays: list[Array], axis: int = -1) -> Array:
    """Arrays as one, along an axis."""
    return torch.cat(arrays, dim=axis) if isinstance(arrays[0], Tensor) else np.concatenate(arrays, axis=axis)


def matmul(first: Array, second: Array) -> Array:
    """Return the products (B, i, k) of matrices (B, i, j) and (B, j, k)."""
    return torch.bmm(first, second) if isinstance(first, Tensor) else first @ second


def length(vectors: Array) -> Array:
    """(...) lengths of vectors (..., D)."""
    return (vectors * vectors).sum(-1) ** 0.5


def known_all_false(conditions: Array) -> bool:
    """Return whether all flags are known to be False; on a GPU False, as asking would wait for the device."""
    return not isinstance(conditions, Tensor) and not conditions.any()


def known_all_true(conditions: Array) -> bool:
    """Return whether all flags are known to be True; on a GPU False, as asking would wait for the device."""
    return not isinstance(conditions, Tensor) and bool(conditions.all())


def count_up(count: int, like: Array) -> Array:
    """(count,) whole numbers from 0 on, of the kind and where ``like`` is."""
    return torch.arange(count, device=like.device) if isinstance(like, Tensor) else np.arange(count)
