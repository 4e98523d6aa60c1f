"""Many layouts in one ``.npy`` file: an array of records in single precision.

- A layout table belongs to a layout cache and to PhysX on a CPU or a GPU. It has S rows (objects seeds) and L columns
  (layout seeds). It is mapped into memory, so that a reset of any number of envs is one gather.
- Frozen layouts belong to a protocol: the layouts of a list of seeds, which give the same scenes on every machine.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from enum import IntEnum
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.documents import DAMAGED_FILE_ERRORS, check_regular_file, load_npy
from robocas_ms3.core.errors import LayoutError
from robocas_ms3.core.files import atomic_file
from robocas_ms3.core.poses import from_wxyz, to_wxyz
from robocas_ms3.scenes.layout import Layout, ObjectIds

Engine = Literal["cpu", "gpu"]

SeedPair = tuple[int, int]
"""Objects seed, seed."""

_FIX = "Build the table again: robocas layouts build."


class LayoutStatus(IntEnum):
    """Status of a layout in a layout table."""

    MISSING = 0
    UNCHECKED = 1  # stable in the engine that sampled it, not yet checked in the engine of the table
    STABLE = 2
    UNSTABLE = 3  # objects move in the engine of the table


def is_usable(statuses: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return for each status whether an episode may start with the layout: unchecked or stable."""
    return (statuses == LayoutStatus.UNCHECKED) | (statuses == LayoutStatus.STABLE)


class LayoutTable:
    """A layout table that is mapped into memory.

    Args:
        path: the file.
        names: sorted ids of all objects in the object pack.

    Attributes:
        rows: (S, L) records: a row for each of S objects seeds, a column for each of L seeds.

    Raises:
        LayoutError: the file is damaged.
    """

    def __init__(self, path: Path, names: Sequence[str]) -> None:
        self._names = list(names)
        self.rows = _open_array(path, partial(np.lib.format.open_memmap, mode="r"), "not a layout table", dimensions=2)
        self._sets, self._seeds = self.rows["objects_seed"][:, 0].copy(), self.rows["seed"][0].copy()  # rising
        self._statuses = self.rows["state"].copy()

    def find_records(
        self, objects_seeds: NDArray[np.int64], seeds: NDArray[np.int64]
    ) -> tuple[NDArray, NDArray, NDArray]:
        """Find E seed pairs in the table.

        Returns:
            `LayoutStatus`, row and column of each pair, (E,) each. The status of a pair without a layout is `MISSING`.
        """
        rows = np.minimum(np.searchsorted(self._sets, objects_seeds), len(self._sets) - 1)
        columns = np.minimum(np.searchsorted(self._seeds, seeds), len(self._seeds) - 1)
        there = (self._sets[rows] == objects_seeds) & (self._seeds[columns] == seeds)
        return np.where(there, self._statuses[rows, columns], LayoutStatus.MISSING), rows, columns

    def status(self, pair: SeedPair) -> LayoutStatus:
        return LayoutStatus(int(self.find_records(np.array([pair[0]]), np.array([pair[1]]))[0][0]))

    def find_pairs(self, *statuses: LayoutStatus) -> list[SeedPair]:
        """Return the seed pairs whose layouts have one of the statuses.

        Without arguments, return the seed pairs of all layouts.
        """
        rows, columns = np.nonzero(np.isin(self._statuses, statuses) if statuses else self._statuses)
        return [*zip(self._sets[rows].tolist(), self._seeds[columns].tolist(), strict=True)]

    def has_usable_layout(self, objects_seed: int) -> bool:
        return bool(is_usable(self._statuses[self._sets == objects_seed]).any())

    def object_ids(self, objects_seed: int) -> ObjectIds | None:
        """Return the object ids of an objects seed; None if the table has no row for it."""
        row = int(np.searchsorted(self._sets, objects_seed))
        if row == len(self._sets) or self._sets[row] != objects_seed:
            return None
        column = int(np.argmax(self._statuses[row] != LayoutStatus.MISSING))
        return tuple(str(self._names[i]) for i in self.rows["objects"][row, column].tolist())

    def layout(self, pair: SeedPair) -> Layout | None:
        """Return the layout of a seed pair, in single precision; None if the table does not have it."""
        state, rows, columns = self.find_records(np.array([pair[0]]), np.array([pair[1]]))
        return _to_layout(self.rows[rows[0], columns[0]], self._names) if state[0] != LayoutStatus.MISSING else None


def write_table(
    path: Path,
    names: Sequence[str],
    layouts: Mapping[SeedPair, Layout],
    statuses: Mapping[SeedPair, LayoutStatus] = MappingProxyType({}),
) -> None:
    """Write a layout table.

    Args:
        path: the file.
        names: sorted ids of all objects in the object pack.
        layouts: layout of each seed pair. Other pairs of these objects seeds and seeds get `LayoutStatus.MISSING`.
        statuses: status of each seed pair; default: `LayoutStatus.UNCHECKED`.
    """
    records = _to_records(names, layouts, statuses)
    sets, row = np.unique(records["objects_seed"], return_inverse=True)
    seeds, column = np.unique(records["seed"], return_inverse=True)
    rows = np.zeros((len(sets), len(seeds)), records.dtype)
    rows["objects_seed"], rows["seed"] = sets[:, None], seeds
    rows[row, column] = records
    _save(path, rows)


def write_statuses(path: Path, names: Sequence[str], statuses: Mapping[SeedPair, LayoutStatus]) -> None:
    """Change the statuses of seed pairs in a table file.

    A pair without a layout stays `LayoutStatus.MISSING`.
    """
    table = LayoutTable(path, names)
    rows = np.array(table.rows)
    for pair, state in statuses.items():
        before, row, column = table.find_records(np.array([pair[0]]), np.array([pair[1]]))
        if before[0] != LayoutStatus.MISSING:
            rows["state"][row[0], column[0]] = state
    _save(path, rows)


class FrozenLayouts:
    """A `LayoutSource` that reads the frozen layouts of a protocol.

    Args:
        path: the file.
        names: ids of all objects in the object pack.

    Raises:
        LayoutError: the file is damaged.
    """

    def __init__(self, path: Path, names: Collection[str]) -> None:
        self._path, self._names = path, sorted(names)
        self._records = _open_array(path, load_npy, "not a file of frozen layouts", dimensions=1)
        self._places = {int(seed): i for i, seed in enumerate(self._records["seed"])}

    @property
    def seed_range(self) -> tuple[int, int]:
        """First and last seed of the range without gaps that starts with the least seed."""
        first = last = min(self._places)
        while last + 1 in self._places:
            last += 1
        return first, last

    def __call__(self, objects_seed: int, seed: int) -> Layout:
        """Return the layout of a seed. Objects seed and seed must be equal.

        Raises:
            LayoutError: the file has no layout of the seed, or the two seeds differ.
        """
        if objects_seed != seed or seed not in self._places:
            found = seed if objects_seed == seed else f"objects of {objects_seed}, layout of {seed}"
            expected = f"one of {len(self._places)} seeds from {min(self._places)} to {max(self._places)}"
            raise LayoutError("no frozen layout of this seed", where=self._path, expected=expected, found=found)
        return _to_layout(self._records[self._places[seed]], self._names)


def write_frozen_layouts(path: Path, names: Collection[str], layouts: Mapping[int, Layout]) -> None:
    _save(path, _to_records(sorted(names), {(seed, seed): layout for seed, layout in layouts.items()}))


def join_frozen_layouts(path: Path, parts: Sequence[Path]) -> None:
    """Join files of frozen layouts of one configuration into one file.

    Args:
        path: the written file.
        parts: the files, in the order of the layouts.

    Raises:
        LayoutError: a file is damaged, or belongs to another configuration.
    """
    pieces = [_open_array(part, load_npy, "not a file of frozen layouts", dimensions=1) for part in parts]
    for part, piece in zip(parts, pieces, strict=True):
        if piece.dtype["objects"] != pieces[0].dtype["objects"]:
            what = "frozen layouts of another configuration"
            expected = f"{pieces[0]['objects'].shape[-1]} objects per layout, as in {parts[0]}"
            found = f"{piece['objects'].shape[-1]} objects"
            raise LayoutError(what, where=part, expected=expected, found=found)
    _save(path, np.concatenate(pieces))


def _to_records(
    names: Sequence[str],
    layouts: Mapping[SeedPair, Layout],
    statuses: Mapping[SeedPair, LayoutStatus] = MappingProxyType({}),
) -> NDArray[np.void]:
    slots = len(next(iter(layouts.values())).object_ids)
    words = max(1, *(len(layout.relation) for layout in layouts.values()))
    number = {name: i for i, name in enumerate(names)}
    records = np.zeros(len(layouts), _record_type(slots, words))
    for i, (pair, layout) in enumerate(layouts.items()):
        records[i] = (
            *pair,
            statuses.get(pair, LayoutStatus.UNCHECKED),
            [number[name] for name in layout.object_ids],
            to_wxyz(layout.object_poses),
            to_wxyz(layout.robot_pose),
            np.nan if layout.basket_pose is None else to_wxyz(layout.basket_pose),
            layout.target,
            layout.relation,
            layout.present,
            layout.visible_fractions,
        )
    return records


def _to_layout(record: Any, names: Sequence[str]) -> Layout:
    try:
        layout = Layout(
            object_ids=tuple(str(names[i]) for i in record["objects"].tolist()),
            object_poses=from_wxyz(record["object_poses"]),
            robot_pose=from_wxyz(record["robot_pose"]),
            basket_pose=None if np.isnan(record["basket_pose"]).any() else from_wxyz(record["basket_pose"]),
            target=int(record["target"]),
            relation=str(record["relation"]),
            present=record["present"].copy(),
            visible_fractions=record["visible_shares"].astype(np.float64),
        )
        layout.check(names)
    except (ValueError, IndexError) as error:
        raise LayoutError("damaged layout in a layout table", found=error, fix=_FIX) from error
    return layout


def _open_array(path: Path, load: Callable[[Path], Any], what: str, *, dimensions: int) -> NDArray[np.void]:
    try:
        check_regular_file(path)
        rows = load(path)
        slots, words = rows.dtype["present"].itemsize, rows.dtype["relation"].itemsize // 4
        if rows.dtype != _record_type(slots, words) or rows.ndim != dimensions or not rows.size:
            raise ValueError("the array does not have the fields of layouts")
    except (*DAMAGED_FILE_ERRORS, KeyError, TypeError) as error:
        raise LayoutError(what, where=path, found=error, fix=_FIX if dimensions == 2 else "") from error
    return rows


def _save(path: Path, rows: NDArray[np.void]) -> None:
    with atomic_file(path) as tmp, tmp.open("wb") as file:
        np.save(file, rows)


def _record_type(slots: int, words: int) -> np.dtype:
    return np.dtype(
        [
            ("objects_seed", "i8"),
            ("seed", "i8"),
            ("state", "u1"),
            ("objects", "i4", (slots,)),  # indices into the sorted names
            ("object_poses", "f4", (slots, 7)),
            ("robot_pose", "f4", 7),
            ("basket_pose", "f4", 7),
            ("target", "i2"),
            ("relation", f"U{words}"),
            ("present", "?", (slots,)),
            ("visible_shares", "f4", (slots,)),  # visible fractions; frozen protocols have this name
        ]
    )
