"""Layouts of a list of seeds in one small file, as they were found once: the same scenes on every machine."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.documents import DAMAGED, load_array
from robocas_ms3.core.errors import LayoutError
from robocas_ms3.core.files import replacing
from robocas_ms3.scenes.layout import Layout
from robocas_ms3.scenes.table import as_records, check_record, read_record


class FrozenLayouts:
    """A source of layouts (`source.LayoutSource`) that makes none.

    Args:
        path: of the file.
        names: ids of the object pack's objects.

    Raises:
        LayoutError: it is damaged.
    """

    def __init__(self, path: Path, names: Collection[str]) -> None:
        self._path, self._names = path, sorted(names)
        try:
            self._records = load_array(path)
            check_record(self._records.dtype)
            self._places = {int(seed): i for i, seed in enumerate(self._records["seed"])}
        except (*DAMAGED, IndexError, KeyError, TypeError) as error:
            raise LayoutError("no frozen layouts", where=path, found=error) from error

    @property
    def seeds(self) -> tuple[int, int]:
        """Least and greatest of the seeds that follow one another from the least on."""
        first = last = min(self._places)
        while last + 1 in self._places:
            last += 1
        return first, last

    def __call__(self, objects_seed: int, seed: int) -> Layout:
        """The layout of a seed, and of its own objects.

        Raises:
            LayoutError: it is none of those.
        """
        if objects_seed != seed or seed not in self._places:
            found = seed if objects_seed == seed else f"objects of {objects_seed}, layout of {seed}"
            raise LayoutError("has no layout of this seed", where=self._path, found=found)
        return read_record(self._records[self._places[seed]], self._names)


def write_frozen(path: Path, names: Collection[str], layouts: Mapping[int, Layout]) -> None:
    """Write layouts by their seeds; see `FrozenLayouts`."""
    records = as_records(sorted(names), {(seed, seed): layout for seed, layout in layouts.items()})
    with replacing(path) as tmp, tmp.open("wb") as file:
        np.save(file, records)


def join_frozen(path: Path, parts: Sequence[Path]) -> None:
    """Join files of one configuration's layouts, in the order given; see `FrozenLayouts`.

    Raises:
        LayoutError: one of them is damaged, or of another configuration.
    """
    pieces: list[NDArray[np.void]] = []
    for part in parts:
        try:
            pieces.append(load_array(part))
            check_record(np.concatenate([pieces[0][:0], pieces[-1][:0]]).dtype)  # texts may be of other lengths
        except (*DAMAGED, IndexError, KeyError, TypeError) as error:
            raise LayoutError("no frozen layouts", where=part, found=error) from error
    with replacing(path) as tmp, tmp.open("wb") as file:
        np.save(file, np.concatenate(pieces))
