"""Memory that processes share: one array a field, with a row for each env."""

from __future__ import annotations

import mmap
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

Path = tuple[str, ...]  # of a leaf in nested dictionaries; () where there is but one array
_ALIGNMENT = 64  # bytes


@dataclass(frozen=True)
class Field:
    """One array of a block.

    Attributes:
        path: its name, by parts.
        shape: of one env's row.
        dtype: NumPy's name of it.
    """

    path: Path
    shape: tuple[int, ...]
    dtype: str


class Block:
    """Arrays (num_envs, ...) in memory behind a file descriptor, by their paths.

    Memory of its own (``memfd``) and not a file in ``/dev/shm``, which is 64 MB in many containers, and where what is
    left of a killed process stays.
    """

    def __init__(self, descriptor: int, fields: Sequence[Field], num_envs: int) -> None:
        sizes = [num_envs * int(np.prod(field.shape)) * np.dtype(field.dtype).itemsize for field in fields]
        starts = np.cumsum([0, *(-(-size // _ALIGNMENT) * _ALIGNMENT for size in sizes)]).tolist()
        if os.fstat(descriptor).st_size < starts[-1]:
            os.ftruncate(descriptor, starts[-1])
        memory = mmap.mmap(descriptor, starts[-1])
        self.arrays: dict[Path, NDArray[Any]] = {
            field.path: np.ndarray((num_envs, *field.shape), field.dtype, memory, start)
            for field, start in zip(fields, starts, strict=False)
        }

    def under(self, name: str) -> dict[Path, NDArray[Any]]:
        """The arrays whose paths begin with a name, by the rest of their paths."""
        return {path[1:]: array for path, array in self.arrays.items() if path[0] == name}


def open_memory() -> int:
    """File descriptor of new memory that grows as a block needs it."""
    return os.memfd_create("robocas")


def leaves(nested: Any, path: Path = ()) -> Iterator[tuple[Path, Any]]:
    """(path, leaf) of nested dictionaries, in their order."""
    if isinstance(nested, dict):
        for name, value in nested.items():
            yield from leaves(value, (*path, name))
    else:
        yield path, nested


def nest(flat: dict[Path, Any]) -> Any:
    """Nested dictionaries, or the one leaf itself, from `leaves`."""
    if () in flat:
        return flat[()]
    nested: dict[str, Any] = {}
    for path, leaf in flat.items():
        inner = nested
        for name in path[:-1]:
            inner = inner.setdefault(name, {})
        inner[path[-1]] = leaf
    return nested


def space_fields(space: gym.Space, path: Path) -> list[Field]:
    """Fields of the observations of a space of one env.

    Raises:
        TypeError: it is neither a box nor a dictionary of boxes.
    """
    if isinstance(space, gym.spaces.Dict):
        return [field for name, inner in space.items() for field in space_fields(inner, (*path, name))]
    if not isinstance(space, gym.spaces.Box):
        raise TypeError(f"observations are boxes and dictionaries of them, not {space}")
    return [Field(path, space.shape, space.dtype.name)]
