"""Tables of decisions and candidates in memory: build them from records, select rows and concatenate them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.demos.candidates.records import DecisionRecord
from robocas_ms3.demos.candidates.schema import (
    CANDIDATE_FIELDS,
    CANDIDATES,
    DECISION_FIELDS,
    DECISIONS,
    SLOTS,
    Field,
)

Arrays = dict[str, NDArray[Any]]
INDEX_FIELDS = ("first_candidate", "candidate_count", "decision_row")
"""Fields that follow from the order of the rows."""
FIELDS: Mapping[str, tuple[Field, ...]] = {DECISIONS: DECISION_FIELDS, CANDIDATES: CANDIDATE_FIELDS}


@dataclass
class Tables:
    """Content of a file: D decisions, their states, and N candidates with K object slots.

    Attributes:
        decisions: arrays (D, ...) by name of `schema.DECISION_FIELDS`.
        candidates: arrays (N, ...) by name of `schema.CANDIDATE_FIELDS`.
        states: ``{"actors": {name: (D, 13)}, "articulations": {name: (D, width)}, ...}``; rows of missing bodies and
            missing columns are NaN.
    """

    decisions: Arrays
    candidates: Arrays
    states: dict[str, Arrays]

    @property
    def slots(self) -> int:
        """Number K of object slots."""
        return self.decisions["present"].shape[1]

    def select_decisions(self, rows: NDArray[np.int64]) -> Tables:
        """Return the decisions with these row indices, and their candidates."""
        taken = [
            np.arange(self.decisions["first_candidate"][row], self.decisions["first_candidate"][row] + count)
            for row, count in zip(rows, self.decisions["candidate_count"][rows], strict=True)
        ]
        candidates = np.concatenate([np.empty(0, np.int64), *taken])
        tables = Tables(
            {name: values[rows] for name, values in self.decisions.items()},
            {name: values[candidates] for name, values in self.candidates.items()},
            {kind: {name: values[rows] for name, values in of.items()} for kind, of in self.states.items()},
        )
        tables.set_indices(tables.decisions["candidate_count"])
        return tables

    def set_indices(self, counts: NDArray[Any]) -> None:
        """Set the fields in `INDEX_FIELDS` from the number of candidates (D,) of each decision."""
        counts = counts.astype(np.int64)
        self.decisions["candidate_count"] = counts.astype(np.int32)
        self.decisions["first_candidate"] = np.cumsum(counts) - counts
        self.candidates["decision_row"] = np.repeat(np.arange(len(counts)), counts)


def build_tables(records: Sequence[DecisionRecord]) -> Tables:
    """Build tables from the decisions of an episode.

    Raises:
        DatasetError: a value is missing, unknown, or has another shape or type than its field.
    """
    slots = max((record.slots for record in records), default=0)
    found = [candidate for record in records for candidate in record.candidates]
    tables = Tables(
        {field.name: _stack(field, [record.values for record in records], slots) for field in _own(DECISION_FIELDS)},
        {field.name: _stack(field, found, slots) for field in _own(CANDIDATE_FIELDS)},
        {},
    )
    tables.set_indices(np.array([len(record.candidates) for record in records], np.int64))
    rows = [
        {kind: {name: np.asarray(value)[None] for name, value in of.items()} for kind, of in record.state.items()}
        for record in records
    ]
    tables.states = _concatenate_states(rows, [1] * len(rows))
    return tables


def concatenate(parts: Sequence[Tables]) -> Tables:
    """Concatenate tables in order; slots, bodies and columns that a part lacks are padded.

    Raises:
        DatasetError: the states of the parts have different types.
    """
    slots = max((part.slots for part in parts), default=0)
    counts = [len(part.decisions["seed"]) for part in parts]
    tables = Tables(
        {f.name: _concatenate_field(f, [part.decisions[f.name] for part in parts], slots) for f in DECISION_FIELDS},
        {f.name: _concatenate_field(f, [part.candidates[f.name] for part in parts], slots) for f in CANDIDATE_FIELDS},
        _concatenate_states([part.states for part in parts], counts),
    )
    tables.set_indices(tables.decisions["candidate_count"])
    return tables


def row_shape(field: Field, slots: int) -> tuple[int, ...]:
    """Return the shape of a row of a field with K = ``slots``."""
    return tuple(slots if axis == SLOTS else int(axis) for axis in field.shape)


def _own(fields: Iterable[Field]) -> list[Field]:
    return [field for field in fields if field.name not in INDEX_FIELDS]


def _stack(field: Field, rows: Sequence[Mapping[str, Any]], slots: int) -> NDArray[Any]:
    values = []
    for row in rows:
        if field.name not in row:
            raise DatasetError("missing value of a decision or candidate", where=field.name)
        value = np.asarray(row[field.name], _numpy_type(field))
        own = len(value) if field.shape[:1] == (SLOTS,) and value.ndim else slots
        if own > slots or value.shape != row_shape(field, own):
            expected = f"shape {row_shape(field, slots)}"
            raise DatasetError("wrong shape", where=field.name, expected=expected, found=f"shape {value.shape}")
        values.append(_pad_slots(field, value[None], slots))
    return np.concatenate([np.empty((0, *row_shape(field, slots)), _numpy_type(field)), *values])


def _concatenate_field(field: Field, parts: Sequence[NDArray[Any]], slots: int) -> NDArray[Any]:
    empty = np.empty((0, *row_shape(field, slots)), _numpy_type(field))
    return np.concatenate([empty, *(_pad_slots(field, part, slots) for part in parts)])


def _pad_slots(field: Field, values: NDArray[Any], slots: int) -> NDArray[Any]:
    if SLOTS not in field.shape or values.shape[1] == slots:
        return values
    padding = np.full((len(values), slots - values.shape[1], *values.shape[2:]), field.padding, values.dtype)
    return np.concatenate([values, padding], axis=1)


def _numpy_type(field: Field) -> str:
    return "U" if field.dtype == "str" else field.dtype


def _concatenate_states(parts: Sequence[Mapping[str, Arrays]], counts: Sequence[int]) -> dict[str, Arrays]:
    parts = [part for part, count in zip(parts, counts, strict=True) if count]
    counts = [count for count in counts if count]
    names = dict.fromkeys((kind, name) for part in parts for kind, of in part.items() for name in of)
    states: dict[str, Arrays] = {}
    for kind, name in names:
        values = [part.get(kind, {}).get(name) for part in parts]
        states.setdefault(kind, {})[name] = _concatenate_body(f"{kind}/{name}", values, counts)
    return states


def _concatenate_body(name: str, parts: Sequence[NDArray[Any] | None], counts: Sequence[int]) -> NDArray[Any]:
    """Concatenate the states (D, width) of a body; NaN in missing rows and columns of float states."""
    present = [part for part in parts if part is not None]
    dtype, width = present[0].dtype, max(part.shape[1] for part in present)
    shapes = {(part.shape[1], part.dtype) for part in present} | ({None} if len(present) < len(parts) else set())
    if {part.dtype for part in present} != {dtype} or (len(shapes) > 1 and dtype.kind != "f"):
        raise DatasetError("states differ in type or width", where=name, found=sorted(map(str, shapes)))
    padded = [
        np.full((count, width), np.nan, dtype) if part is None else part
        for part, count in zip(parts, counts, strict=True)
    ]
    return np.concatenate([part if part.shape[1] == width else _pad_columns(part, width) for part in padded])


def _pad_columns(values: NDArray[Any], width: int) -> NDArray[Any]:
    return np.pad(values, ((0, 0), (0, width - values.shape[1])), constant_values=np.nan)
