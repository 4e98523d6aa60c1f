"""Layouts of many envs as arrays: one file that is mapped into memory, so that a reset of any number is a gather.

A table holds S sets of objects (by the seed that drew them) with L layouts each (by their own seeds), for one engine:
PhysX on a CPU or on a GPU. It is made of a bank (`fill.fill`, then `LayoutBank.write_table`) and lies beside its
layouts. On a GPU the engine then tries whether the objects stay (`tasks.trial`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import IntEnum
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.documents import DAMAGED, check_regular
from robocas_ms3.core.errors import LayoutError
from robocas_ms3.core.files import replacing
from robocas_ms3.core.poses import from_wxyz, to_wxyz
from robocas_ms3.scenes.layout import Layout, ObjectIds

Engine = Literal["cpu", "gpu"]

Pair = tuple[int, int]
"""Objects seed, seed."""

_MADE_BY = "Make it again: robocas layouts build."
_AXES = ("objects_seed", (slice(None), 0)), ("seed", (0, slice(None)))  # both in rising order


class State(IntEnum):
    """What is known of a layout of a table."""

    LACKING = 0
    UNTRIED = 1  # good, as far as the engine that made it can tell
    STAYS = 2
    MOVES = 3  # its objects do, by the engine that the table is for


def good(states: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Which `State` allows an episode to begin there."""
    return (states == State.UNTRIED) | (states == State.STAYS)


class LayoutTable:
    """Layouts from a mapped file.

    Args:
        path: of the file.
        names: ids of the object pack's objects, sorted.

    Attributes:
        rows: (S, L) records, mapped.

    Raises:
        LayoutError: it is damaged.
    """

    def __init__(self, path: Path, names: Sequence[str]) -> None:
        self._names: list[str] = list(names)
        try:
            check_regular(path)
            self.rows: NDArray[np.void] = np.lib.format.open_memmap(path, mode="r")
            self._sets, self._seeds = (self.rows[name][place].copy() for name, place in _AXES)
            self._states = self.rows["state"].copy()
            check_record(self.rows.dtype)
        except (*DAMAGED, IndexError, KeyError, TypeError) as error:  # of other fields
            raise LayoutError("no table of layouts", where=path, found=error, fix=_MADE_BY) from error

    def places(self, objects_seeds: NDArray[np.int64], seeds: NDArray[np.int64]) -> tuple[NDArray, NDArray, NDArray]:
        """Where E pairs are, (E,) each: the `State`, of what is not there `LACKING`; row; column."""
        rows = np.minimum(np.searchsorted(self._sets, objects_seeds), len(self._sets) - 1)
        columns = np.minimum(np.searchsorted(self._seeds, seeds), len(self._seeds) - 1)
        there = (self._sets[rows] == objects_seeds) & (self._seeds[columns] == seeds)
        return np.where(there, self._states[rows, columns], State.LACKING), rows, columns

    def state(self, pair: Pair) -> State:
        """What is known of a layout."""
        return State(int(self.places(np.array([pair[0]]), np.array([pair[1]]))[0][0]))

    def pairs(self, *states: State) -> list[Pair]:
        """Objects seed and seed of the layouts that it holds, of those states alone if any is named."""
        rows, columns = np.nonzero(np.isin(self._states, states) if states else self._states)
        return [*zip(self._sets[rows].tolist(), self._seeds[columns].tolist(), strict=True)]

    def stays(self, objects_seed: int) -> bool:
        """Whether any layout of a seed's objects is good, as far as is known."""
        row = self._states[self._sets == objects_seed]
        return bool(good(row).any())

    def object_ids(self, objects_seed: int) -> ObjectIds | None:
        """The objects of a seed; None where it has no layout of them."""
        row = int(np.searchsorted(self._sets, objects_seed))
        if row == len(self._sets) or self._sets[row] != objects_seed:
            return None
        some = int(np.argmax(self._states[row] != State.LACKING))
        return tuple(str(self._names[i]) for i in self.rows["objects"][row, some].tolist())

    def layout(self, pair: Pair) -> Layout | None:
        """A layout, in single precision; None where it lacks it."""
        state, rows, columns = self.places(np.array([pair[0]]), np.array([pair[1]]))
        if state[0] == State.LACKING:
            return None
        return read_record(self.rows[rows[0], columns[0]], self._names)


def write_table(
    path: Path, names: Sequence[str], layouts: Mapping[Pair, Layout], states: Mapping[Pair, State] | None = None
) -> None:
    """Write layouts as a table.

    Args:
        path: of the file.
        names: ids of the object pack's objects, sorted.
        layouts: by objects seed and seed, those of an objects seed all of the same objects; pairs of these seeds that
            are missing have no layout.
        states: what is known of them; default: `State.UNTRIED`.
    """
    sets, seeds = (sorted({pair[side] for pair in layouts}) for side in (0, 1))
    records = as_records(names, layouts, states or {})
    rows = np.zeros((len(sets), len(seeds)), records.dtype)
    rows["objects_seed"], rows["seed"] = np.array(sets)[:, None], seeds
    row_of, column_of = ({seed: i for i, seed in enumerate(axis)} for axis in (sets, seeds))
    rows[[row_of[one] for one, _ in layouts], [column_of[other] for _, other in layouts]] = records
    _save(path, rows)


def mark_table(path: Path, names: Sequence[str], states: Mapping[Pair, State]) -> None:
    """Write what is known of some layouts into a table; those that it lacks it goes on lacking."""
    table = LayoutTable(path, names)
    rows = np.array(table.rows)
    for pair, state in states.items():
        before, row, column = table.places(np.array([pair[0]]), np.array([pair[1]]))
        if before[0] != State.LACKING:
            rows["state"][row[0], column[0]] = state
    _save(path, rows)


def as_records(
    names: Sequence[str], layouts: Mapping[Pair, Layout], states: Mapping[Pair, State] = MappingProxyType({})
) -> NDArray[np.void]:
    """Layouts of equally many slots as records (E,); see `write_table`."""
    slots = len(next(iter(layouts.values())).object_ids)
    words = max(1, *(len(layout.relation) for layout in layouts.values()))
    number = {name: i for i, name in enumerate(names)}
    records = np.zeros(len(layouts), _record(slots, words))
    for i, (pair, layout) in enumerate(layouts.items()):
        records[i] = (
            *pair,
            states.get(pair, State.UNTRIED),
            [number[name] for name in layout.object_ids],
            to_wxyz(layout.object_poses),
            to_wxyz(layout.robot_pose),
            np.nan if layout.basket_pose is None else to_wxyz(layout.basket_pose),
            layout.target,
            layout.relation,
            layout.present,
            layout.visible_shares,
        )
    return records


def read_record(record: Any, names: Sequence[str]) -> Layout:
    """The layout of a record, in single precision.

    Raises:
        LayoutError: it is damaged.
    """
    try:
        layout = Layout(
            object_ids=tuple(str(names[i]) for i in record["objects"].tolist()),
            object_poses=from_wxyz(record["object_poses"]),
            robot_pose=from_wxyz(record["robot_pose"]),
            basket_pose=None if np.isnan(record["basket_pose"]).any() else from_wxyz(record["basket_pose"]),
            target=int(record["target"]),
            relation=str(record["relation"]),
            present=record["present"].copy(),
            visible_shares=record["visible_shares"].astype(np.float64),
        )
        layout.check(names)
    except (ValueError, IndexError) as error:
        raise LayoutError("this layout is damaged", found=error, fix=_MADE_BY) from error
    return layout


def check_record(dtype: np.dtype) -> None:
    """See that an array is one of records.

    Raises:
        ValueError: it isn't.
    """
    slots, words = dtype["present"].itemsize, dtype["relation"].itemsize // 4
    if dtype != _record(slots, words):
        raise ValueError("other fields than a table's")


def _save(path: Path, rows: NDArray[np.void]) -> None:
    with replacing(path) as tmp, tmp.open("wb") as file:
        np.save(file, rows)


def _record(slots: int, words: int) -> np.dtype:
    return np.dtype(
        [
            ("objects_seed", "i8"),
            ("seed", "i8"),
            ("state", "u1"),
            ("objects", "i4", (slots,)),  # numbers among the names
            ("object_poses", "f4", (slots, 7)),
            ("robot_pose", "f4", 7),
            ("basket_pose", "f4", 7),
            ("target", "i2"),
            ("relation", f"U{words}"),
            ("present", "?", (slots,)),
            ("visible_shares", "f4", (slots,)),
        ]
    )
