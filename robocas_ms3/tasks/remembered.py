"""Measures that are taken anew only where what they are taken of has changed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

import torch

_T = TypeVar("_T")


class Remembered(Generic[_T]):
    """A function of tensors, with its last result: most of the time nothing moves.

    Args:
        measure: the function; its result is given out again, so nobody may write to it.
    """

    def __init__(self, measure: Callable[..., _T]) -> None:
        self._measure = measure
        self._known: tuple[tuple[torch.Tensor, ...], _T] | None = None

    def __call__(self, *of: torch.Tensor) -> _T:
        """The measure of these tensors; what they hold is compared, bit for bit."""
        if self._known is not None:
            before, found = self._known
            if all(map(torch.equal, before, of)):
                return found
        found = self._measure(*of)
        self._known = tuple(tensor.clone() for tensor in of), found
        return found
