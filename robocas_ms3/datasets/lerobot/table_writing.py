"""Write Parquet files: columns of numbers, tables that grow over numbered files, and the tables of texts."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from robocas_ms3.datasets.lerobot.tables import TEXT_INDEX
from robocas_ms3.datasets.lerobot.variants import CHUNK_FILES


def column(values: NDArray) -> pa.Array:
    """Return an array as a column: (T, D) as lists of D numbers, (T, 1) and (T,) as numbers."""
    flat = pa.array(np.ascontiguousarray(values).reshape(-1))
    width = values.shape[1] if values.ndim == 2 else 1
    return flat if width == 1 else pa.FixedSizeListArray.from_arrays(flat, width)


class RollingTable:
    """Write a table to numbered files, row group by row group."""

    def __init__(
        self, path: Callable[[int, int], Path], limit_mb: float, group: int = 1, compression: str = "snappy"
    ) -> None:
        """Nothing is written yet.

        Args:
            path: of a file, from chunk and file number.
            limit_mb: size a file may have, 2^20 bytes; 0: each table that is added has a file of its own.
            group: how many tables are written together.
            compression: of columns.
        """
        self._path, self._limit, self._group, self._compression = path, limit_mb * 2**20, group, compression
        self._count = 0
        self._waiting: list[pa.Table] = []
        self._file: Any = None
        self._writer: pq.ParquetWriter | None = None
        self._schema: pa.Schema | None = None

    def place(self, size: int = 0) -> tuple[int, int]:
        """Return chunk and file number for the next rows, of about ``size`` bytes."""
        if self._file is not None and self._file.tell() + size > self._limit and self._file.tell() > 4:  # its head
            self.close()
        number = self._count if self._file is None else self._count - 1
        return divmod(number, CHUNK_FILES)

    def add(self, table: pa.Table) -> None:
        """Append rows to the file that `place` returned."""
        if self._file is None:
            path = self._path(*divmod(self._count, CHUNK_FILES))
            path.parent.mkdir(parents=True, exist_ok=True)
            self._schema = self._schema or table.schema
            self._file = path.open("wb")
            self._writer = pq.ParquetWriter(self._file, self._schema, compression=self._compression)
            self._count += 1
        self._waiting.append(table.cast(self._schema))
        if len(self._waiting) >= self._group:
            self._flush()

    def close(self) -> None:
        """Finish the file that is being written."""
        if self._writer is not None:
            self._flush()
            self._writer.close()
            self._file.close()
            self._writer = self._file = None

    def _flush(self) -> None:
        if self._waiting:
            assert self._writer is not None
            self._writer.write_table(pa.concat_tables(self._waiting).combine_chunks())
            self._waiting.clear()


def write_texts(path: Path, name: str, texts: Sequence[str]) -> None:
    """Write a table of texts and their numbers; pandas makes the texts its index, by which LeRobot finds them."""
    index = TEXT_INDEX
    about = {
        "index_columns": [index],
        "column_indexes": [
            {
                "name": None,
                "field_name": None,
                "pandas_type": "unicode",
                "numpy_type": "object",
                "metadata": {"encoding": "UTF-8"},
            }
        ],
        "columns": [
            {"name": name, "field_name": name, "pandas_type": "int64", "numpy_type": "int64", "metadata": None},
            {"name": None, "field_name": index, "pandas_type": "unicode", "numpy_type": "object", "metadata": None},
        ],
        "creator": {"library": "pyarrow", "version": pa.__version__},
        "pandas_version": "2.0.0",
    }
    table = pa.table({name: pa.array(range(len(texts)), pa.int64()), index: pa.array(list(texts), pa.string())})
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table.replace_schema_metadata({"pandas": json.dumps(about)}), path)
