"""Append-only JSON Lines files, such as the outcomes of episodes.

A run may be killed while it writes: an incomplete last line is ignored, and the next append replaces it. A line with a
NaN or infinite number is damaged.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import asdict, dataclass, is_dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Generic, TypeVar

from pydantic import TypeAdapter, ValidationError

from robocas_ms3.core.documents import read_bytes
from robocas_ms3.core.errors import RobocasError
from robocas_ms3.core.files import add_path_to_errors, atomic_file, encode_json, open_for_append
from robocas_ms3.core.strict_model import error_from_validation, validate_json

Record = TypeVar("Record")
_Error = TypeVar("_Error", bound=RobocasError)
_LIMIT = 2**30  # bytes; a million lines have about 300 MB


@dataclass(frozen=True)
class Line(Generic[Record]):
    """A line of a JSON Lines file, with its record or the reason why it is damaged."""

    number: int  # from 1 on
    record: Record | None  # None: the line is damaged
    problem: ValidationError | None = None
    cut_off: bool = False  # a damaged last line without a line end: the run was killed


_type_adapter = lru_cache(TypeAdapter)


class JsonLinesFile(Generic[Record]):
    """A JSON Lines file with records of one type.

    Args:
        path: of the file, which need not exist.
        record: type of a line: a dataclass or a JSON type. Types are checked; unknown keys are ignored.
    """

    def __init__(self, path: Path, record: Any) -> None:
        self.path = path
        self._form: TypeAdapter[Record] = _type_adapter(record)

    def read_lines(self) -> list[Line[Record]]:
        """Read all lines except empty ones, including damaged lines; return [] if the file does not exist."""
        try:
            pieces = read_bytes(self.path, _LIMIT).split(b"\n")
        except FileNotFoundError:
            return []
        return [self._parse_line(number, piece, len(pieces)) for number, piece in enumerate(pieces, 1) if piece.strip()]

    def read(self) -> list[Record]:
        """Read the records of all lines that are not damaged."""
        return [line.record for line in self.read_lines() if line.record is not None]

    def append(self, records: Iterable[Record], *, sync: bool = False) -> None:
        """Append one line per record; do nothing without records.

        Args:
            records: the records.
            sync: whether to flush the file to the disk.
        """
        text = _encode_lines(records, self.path)
        if not text:
            return
        with add_path_to_errors(self.path), open_for_append(self.path) as file:
            self._end_last_line(file)
            file.write(text)
            file.flush()
            if sync:
                os.fsync(file.fileno())

    def rewrite(self, records: Iterable[Record]) -> None:
        """Replace the file atomically by a file with one line per record."""
        with atomic_file(self.path) as tmp:
            tmp.write_bytes(_encode_lines(records, self.path))

    def make_line_error(self, line: Line[Record], error: type[_Error], about: str) -> _Error:
        """Make an ``error`` for a damaged line of this file; ``about`` is the start of the message."""
        assert line.problem is not None
        return error_from_validation(line.problem, self._form, error, where=f"{self.path}:{line.number}", about=about)

    def _parse_line(self, number: int, text: bytes, last: int) -> Line[Record]:
        try:
            return Line(number, validate_json(self._form, text))
        except ValidationError as problem:
            return Line(number, None, problem, cut_off=number == last)

    def _end_last_line(self, file: Any) -> None:
        """Remove an incomplete last line, or end a complete last line that has no line end."""
        if file.seek(0, os.SEEK_END):
            file.seek(-1, os.SEEK_END)
        if file.read() in (b"", b"\n"):
            return
        file.seek(0)
        rest = file.read().rpartition(b"\n")[2]
        if self._parse_line(1, rest, 1).record is None:
            file.truncate(file.tell() - len(rest))
        else:
            file.write(b"\n")


def _encode_lines(records: Iterable[Any], path: Path) -> bytes:
    plain = (asdict(record) if is_dataclass(record) and not isinstance(record, type) else record for record in records)
    return "".join(encode_json(record, path, ascii_only=True) + "\n" for record in plain).encode()
