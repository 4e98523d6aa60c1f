"""Parquet tables: numeric columns, and reading of untrusted files within memory limits."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from robocas_ms3.core.documents import check_regular_file
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.text import one_line
from robocas_ms3.datasets.sources.files import SEE_VALIDATE

_ARRAYS_LIMIT = 2**29  # bytes of arrays per read; a file of 1 MB can hold 40 million equal rows
OBJECTS_LIMIT = 2**26
"""Bytes of values per read as Python objects, which need about ten times as much memory."""
INTEGER, NUMBER, TEXT = "integers", "numbers", "texts"
INTEGERS, NUMBERS, TEXTS = "integers or lists of integers", "numbers or lists of numbers", "lists of texts"
TEXT_INDEX = "__index_level_0__"  # name of an unnamed index in pandas
_EPISODE = "episode_index"


@dataclass(frozen=True)
class Column:
    """Declaration of a table column: kind of values, and smallest and largest valid number."""

    kind: str
    least: float = 0
    greatest: float = 2**53

    def find_violation(self, values: pa.ChunkedArray) -> tuple[str, str] | None:
        """Return (expected, found) if the values violate the declaration, None otherwise."""
        if not _is_kind(values.type, self.kind):
            return self.kind, str(values.type)
        if values.null_count:
            return f"{self.kind}, no nulls", f"{values.null_count} nulls"
        if self.kind == TEXTS and pc.list_flatten(values).null_count:  # pyright: ignore[reportAttributeAccessIssue]
            return f"{self.kind}, no nulls", "nulls"
        if self.kind in (INTEGER, NUMBER) and len(values):
            found = values.to_numpy()
            wrong = found[~((found >= self.least) & (found <= self.greatest))]  # NaN too
            if len(wrong):
                return f"{self.kind} from {self.least:g} to {self.greatest:g}", str(wrong[0])
        return None


def find_column_violations(table: pa.Table, columns: Mapping[str, Column]) -> Iterator[tuple[str, str, str]]:
    """Yield (key, expected, found) for each column that is missing or violates its declaration."""
    for key, column in columns.items():
        if key not in table.column_names:
            yield key, "this column", "no such column"
        elif violation := column.find_violation(table.column(key)):
            yield key, *violation


@contextmanager
def open_table(path: Path, *, most_rows: float = np.inf) -> Iterator[pq.ParquetFile]:
    """Open a Parquet file to read; texts are read as Arrow dictionaries to save memory.

    Raises:
        DatasetError: the file is damaged, it has more than ``most_rows`` rows, or Arrow raises an error inside the
            ``with`` statement.
    """
    try:
        check_regular_file(path)
        footer, texts, _ = _read_footer(path, path.stat().st_mtime_ns)
        with pq.ParquetFile(path, metadata=footer, read_dictionary=texts) as file:
            names = file.schema_arrow.names
            if len(set(names)) < len(names):
                raise DatasetError("repeated column names in this table", where=path, fix=SEE_VALIDATE)
            if footer.num_rows > most_rows:
                what, expected = "too many rows in this table", f"at most {most_rows:g}"
                raise DatasetError(what, where=path, expected=expected, found=footer.num_rows, fix=SEE_VALIDATE)
            yield file
    except (OSError, ValueError, LookupError, MemoryError, pa.ArrowException) as error:
        what, found = "the table can't be read", one_line(error)
        raise DatasetError(what, where=path, found=found, fix=SEE_VALIDATE) from error


def to_column(values: NDArray) -> pa.Array:
    """Convert an array to an Arrow column: (T, D) to lists of D numbers, (T, 1) and (T,) to numbers."""
    flat = pa.array(np.ascontiguousarray(values).reshape(-1))
    width = values.shape[1] if values.ndim == 2 else 1
    return flat if width == 1 else pa.FixedSizeListArray.from_arrays(flat, width)


def read_columns(
    file: pq.ParquetFile,
    path: Path,
    columns: Collection[str] | None = None,
    *,
    groups: Sequence[int] | None = None,
    limit: int = _ARRAYS_LIMIT,
) -> pa.Table:
    """Read columns (default: all) of an open file.

    ``groups``: row groups to read; default: all. Values of more than ``limit`` bytes raise DatasetError.
    """
    footer = file.metadata
    groups = range(footer.num_row_groups) if groups is None else groups
    names = file.schema_arrow.names if columns is None else [key for key in file.schema_arrow.names if key in columns]
    leaves = [
        (number, max(8, footer.schema.column(number).length or 0))
        for number in range(footer.num_columns)
        if any(f"{footer.schema.column(number).path}.".startswith(f"{name}.") for name in names)
    ]
    size = 0
    for group in map(footer.row_group, groups):
        for number, width in leaves:
            chunk = group.column(number)
            size += max(group.num_rows, chunk.num_values) * width + chunk.total_uncompressed_size
    table = file.read_row_groups(list(groups), columns=names) if size <= limit else None
    if table is None or (size := size + sum(map(_count_text_bytes, table.columns))) > limit:
        what, expected = "this table is too large", f"at most {limit >> 20} MB of values per file"
        raise DatasetError(
            what, where=path, expected=expected, found=f"{size >> 20} MB", fix="Split the dataset into more files."
        )
    return table


def read_small_table(path: Path, columns: Mapping[str, Column], *, most_rows: float = np.inf) -> pa.Table:
    """Read and check the declared columns of a table that is converted to Python objects."""
    with open_table(path, most_rows=most_rows) as file:
        table = read_columns(file, path, columns, limit=OBJECTS_LIMIT)
        check_columns(table, columns, path)
    return table


def check_columns(table: pa.Table, columns: Mapping[str, Column], path: Path) -> None:
    for key, expected, found in find_column_violations(table, columns):
        what = "invalid column of a table"
        raise DatasetError(what, where=f"{path}, {key}", expected=expected, found=found, fix=SEE_VALIDATE)


def is_numeric(kind: pa.DataType) -> bool:
    """Return whether a column holds numbers, or lists of numbers of any depth."""
    return _is_kind(kind, NUMBERS)


def _is_kind(found: pa.DataType, kind: str) -> bool:
    if kind in (INTEGERS, NUMBERS, TEXTS):
        depth = 0
        while pa.types.is_list(found) or pa.types.is_fixed_size_list(found) or pa.types.is_large_list(found):
            found, depth = found.value_type, depth + 1
        if kind == TEXTS:
            return depth == 1 and _is_kind(found, TEXT)
        return pa.types.is_boolean(found) or _is_kind(found, NUMBER if kind == NUMBERS else INTEGER)
    if kind == TEXT:
        found = found.value_type if pa.types.is_dictionary(found) else found
        return pa.types.is_string(found) or pa.types.is_large_string(found)
    return pa.types.is_integer(found) or (kind == NUMBER and pa.types.is_floating(found))


def _count_text_bytes(values: pa.ChunkedArray | pa.Array) -> int:
    """Count the bytes of a dictionary-encoded text column as if each occurrence of a text were stored."""
    if isinstance(values, pa.ChunkedArray):
        return sum(map(_count_text_bytes, values.chunks))
    if pa.types.is_list(values.type) or pa.types.is_large_list(values.type):
        return _count_text_bytes(values.flatten())
    if pa.types.is_struct(values.type):
        return sum(map(_count_text_bytes, values.flatten()))
    if not pa.types.is_dictionary(values.type) or not len(values):
        return 0
    lengths = pc.binary_length(values.dictionary).to_numpy(zero_copy_only=False)  # pyright: ignore[reportAttributeAccessIssue]
    return int(lengths[values.indices.drop_null().to_numpy()].sum())


def to_array(values: pa.ChunkedArray | pa.Array) -> NDArray:
    """Convert a numeric Arrow column to an array: lists of D numbers to (T, D), numbers to (T, 1)."""
    whole = values.combine_chunks() if isinstance(values, pa.ChunkedArray) else values
    if not is_numeric(whole.type):
        raise DatasetError("not a numeric column", expected=NUMBERS, found=whole.type)
    if not len(whole):
        return np.zeros((0, 1))
    flat = whole
    while not pa.types.is_primitive(flat.type):
        flat = flat.flatten()
    if len(flat) % len(whole):
        raise DatasetError(
            "not a numeric column", expected="lists of equal length", found=f"{len(flat)} numbers in all"
        )
    return flat.to_numpy(zero_copy_only=False).reshape(len(whole), -1)


def read_episode_rows(path: Path, number: int, most_rows: float = np.inf) -> pa.Table:
    """Read the rows of the episode ``number`` from a data file; row groups of other episodes are not read."""
    with open_table(path, most_rows=most_rows) as file:
        _, _, spans = _read_footer(path, path.stat().st_mtime_ns)
        groups = [group for group, (low, high) in enumerate(spans) if low <= number <= high]
        table = read_columns(file, path, groups=groups)
        check_columns(table, {_EPISODE: Column(INTEGER)}, path)
        return table.filter(pc.field(_EPISODE) == number)


@lru_cache(maxsize=8)
def _read_footer(path: Path, _changed_ns: int) -> tuple[pq.FileMetaData, list[str], list[tuple[float, float]]]:
    """Read the footer of a file, its text columns, and the range of episode numbers per row group.

    ``_changed_ns``: time of the last change, so that the cache is not used for a changed file.
    """
    with pq.ParquetFile(path) as file:
        footer = file.metadata
    leaves = [footer.schema.column(number) for number in range(footer.num_columns)]
    texts = [leaf.path for leaf in leaves if leaf.physical_type == "BYTE_ARRAY"]
    place = {leaf.path: place for place, leaf in enumerate(leaves)}.get(_EPISODE)
    groups = range(footer.num_row_groups)
    found = [None if place is None else footer.row_group(group).column(place).statistics for group in groups]
    spans = [(s.min, s.max) if s and s.has_min_max and type(s.min) is int else (-np.inf, np.inf) for s in found]
    return footer, texts, spans


def read_texts(path: Path, name: str, most_rows: float = np.inf) -> list[str]:
    table = read_small_table(path, {name: Column(INTEGER), TEXT_INDEX: Column(TEXT)}, most_rows=most_rows)
    return sort_by_index(table.column(name).to_pylist(), table.column(TEXT_INDEX).to_pylist(), f"{path}, {name}")


def sort_by_index(indices: list[int], texts: list[str], where: str) -> list[str]:
    """Sort texts by ``indices``; raise DatasetError if the indices are not 0, 1, 2, ..."""
    if sorted(indices) != list(range(len(indices))):
        expected = f"0 to {len(indices) - 1}, each once"
        found = sorted(indices)[:5]
        raise DatasetError("invalid indices of texts", where=where, expected=expected, found=found, fix=SEE_VALIDATE)
    return [text for _, text in sorted(zip(indices, texts, strict=True))]


def write_texts(path: Path, name: str, texts: Sequence[str]) -> None:
    """Write a table of texts with the numbers 0, 1, 2, ...

    The texts are the pandas index, as LeRobot expects.
    """
    text = {"pandas_type": "unicode", "numpy_type": "object"}
    number = {"pandas_type": "int64", "numpy_type": "int64"}
    about = {
        "index_columns": [TEXT_INDEX],
        "column_indexes": [{"name": None, "field_name": None, **text, "metadata": {"encoding": "UTF-8"}}],
        "columns": [
            {"name": name, "field_name": name, **number, "metadata": None},
            {"name": None, "field_name": TEXT_INDEX, **text, "metadata": None},
        ],
        "creator": {"library": "pyarrow", "version": pa.__version__},
        "pandas_version": "2.0.0",
    }
    table = pa.table({name: pa.array(range(len(texts)), pa.int64()), TEXT_INDEX: pa.array(list(texts), pa.string())})
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table.replace_schema_metadata({"pandas": json.dumps(about)}), path)
