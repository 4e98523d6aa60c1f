"""Files of JSON lines that grow by a record at a time, such as the outcomes of episodes.

A run may be killed while it writes: a last line that was cut off is no line, and is written over. One with a number
that is NaN or infinite is damaged.
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
from robocas_ms3.core.files import add_path_to_errors, atomic_file, json_text, open_for_append
from robocas_ms3.core.strict_model import error_from_validation, validate_json

Record = TypeVar("Record")
_Error = TypeVar("_Error", bound=RobocasError)
_LIMIT = 2**30  # bytes of a file: a million lines have 300 MB


@dataclass(frozen=True)
class Line(Generic[Record]):
    """A line of the file."""

    number: int  # from 1 on
    record: Record | None  # None: it is damaged
    problem: ValidationError | None = None
    cut_off: bool = False  # perhaps by a kill: it is the last one, and has no end


_form_of = lru_cache(TypeAdapter)


class JsonLinesFile(Generic[Record]):
    """The file.

    Args:
        path: of the file, which may not exist yet.
        record: what a line is: a dataclass, or a type of JSON. Types are checked; unknown keys are ignored.
    """

    def __init__(self, path: Path, record: Any) -> None:
        self.path = path
        self._form: TypeAdapter[Record] = _form_of(record)

    def lines(self) -> list[Line[Record]]:
        """Return all lines but empty ones, the damaged ones too; none if there is no file. Raises as `read_bytes`."""
        try:
            pieces = read_bytes(self.path, _LIMIT).split(b"\n")
        except FileNotFoundError:
            return []
        return [self._read(number, piece, len(pieces)) for number, piece in enumerate(pieces, 1) if piece.strip()]

    def read(self) -> list[Record]:
        """Return the records of all lines that are not damaged."""
        return [line.record for line in self.lines() if line.record is not None]

    def append(self, records: Iterable[Record], *, sync: bool = False) -> None:
        """Add lines, which are on the disk when this returns if ``sync``; no records leave the file as it is."""
        text = _text(records, self.path)
        if not text:
            return
        with add_path_to_errors(self.path), open_for_append(self.path) as file:
            self._end_last_line(file)
            file.write(text)
            file.flush()
            if sync:
                os.fsync(file.fileno())

    def rewrite(self, records: Iterable[Record]) -> None:
        with atomic_file(self.path) as tmp:
            tmp.write_bytes(_text(records, self.path))

    def line_error(self, line: Line[Record], error: type[_Error], about: str) -> _Error:
        """Return an error of ours for a damaged line of this file; ``about`` is what it isn't, such as "no outcome"."""
        assert line.problem is not None
        return error_from_validation(line.problem, self._form, error, where=f"{self.path}:{line.number}", about=about)

    def _read(self, number: int, text: bytes, last: int) -> Line[Record]:
        try:
            return Line(number, validate_json(self._form, text))
        except ValidationError as problem:
            return Line(number, None, problem, cut_off=number == last)

    def _end_last_line(self, file: Any) -> None:
        """Remove a last line that was cut off; end one that only lacks its end."""
        if file.seek(0, os.SEEK_END):
            file.seek(-1, os.SEEK_END)
        if file.read() in (b"", b"\n"):
            return
        file.seek(0)
        rest = file.read().rpartition(b"\n")[2]
        if self._read(1, rest, 1).record is None:
            file.truncate(file.tell() - len(rest))
        else:
            file.write(b"\n")


def _text(records: Iterable[Any], path: Path) -> bytes:
    plain = (asdict(record) if is_dataclass(record) and not isinstance(record, type) else record for record in records)
    return "".join(json_text(record, path, ascii_only=True) + "\n" for record in plain).encode()
