"""Read untrusted JSON, YAML and NumPy files with limits on size and depth, so that no file exhausts the memory.

A file with invalid content raises `DocumentError`, which is a ``ValueError``. A file that cannot be read raises
``OSError``.
"""

from __future__ import annotations

import json
import re
import stat
import tokenize
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from math import isfinite
from pathlib import Path
from typing import Any

import yaml

from robocas_ms3.core.text import one_line

JSON_LIMIT = 256 * 2**20
"""Bytes; the JSON file of 100,000 recorded episodes has 230 MB."""
YAML_LIMIT = 4 * 2**20
ARRAYS_LIMIT = 2**31
"""Bytes of all arrays of an ``.npz`` file after decompression, which can multiply their size by a thousand."""
INTEGER_LIMIT = 2**63
"""Upper bound (exclusive) of the magnitude of integers: NumPy, torch and Parquet store 64 bits."""
JSON_DEPTH = YAML_DEPTH = 64
YAML_NODES = 500_000
"""Values, with aliases expanded: nested aliases can expand a short file to a billion values."""
_TOO_DEEP = f"values are nested more than {JSON_DEPTH} levels deep"
_INTEGER_LENGTH = 64  # characters; the parse time of base 60 ("1:1:1") is quadratic in the length
_SHOWN_KEYS = 8  # of the path to an invalid value
_CONTAINERS = (dict, list, tuple)
_SURROGATE = re.compile(r"[\ud800-\udfff]")  # lone surrogates cannot be encoded

DAMAGED_FILE_ERRORS = (
    *(OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error),
    NotImplementedError,  # damaged flags or compression method of an archive's member
    *(SyntaxError, tokenize.TokenError),  # damaged header of an array
    MemoryError,  # a header that declares a huge array
)
"""The errors that NumPy raises for damaged arrays and archives."""


class DocumentError(ValueError):
    """The content of a file is too large, nested too deeply, or not valid JSON, YAML or NumPy data.

    The message is one line without the path; ``filename`` is the path.
    """

    filename: str = ""  # as in OSError; empty if a string was parsed


@contextmanager
def _add_filename(path: Path) -> Iterator[None]:
    try:
        yield
    except DocumentError as error:
        error.filename = str(path)
        raise


def load_json(path: Path) -> Any:
    """Read a JSON file; raise DocumentError if it is too large, or for values that `find_invalid_value` reports."""
    with _add_filename(path):
        return decode_json(read_text(path, JSON_LIMIT))


def decode_json(text: str | bytes) -> Any:
    """Decode a JSON text; raise DocumentError for invalid JSON and for the values that `find_invalid_value` reports."""
    try:
        values = json.loads(text)
    except ValueError as error:
        raise DocumentError(str(error)) from error
    except RecursionError as error:
        raise DocumentError(_TOO_DEEP) from error
    if invalid := find_invalid_value(values):
        keys, found = invalid
        raise DocumentError(f"{'.'.join(map(repr, keys[:_SHOWN_KEYS]))}: {found}" if keys else found)
    return values


def find_invalid_value(values: Any, depth: int = 0) -> tuple[tuple[Any, ...], str] | None:
    """Find the first value that JSON files of this package must not contain.

    Such values are NaN, infinity, integers of more than 64 bits, lone surrogates, and values nested too deeply.

    Returns:
        The path of keys and indices to the value, and a description of the value; None if all values are valid.
    """
    if not isinstance(values, _CONTAINERS):
        return ((), found) if (found := _describe_invalid_scalar(values)) else None
    if depth == JSON_DEPTH:
        return (), _TOO_DEEP
    is_dict = isinstance(values, dict)
    for key, value in values.items() if is_dict else enumerate(values):
        if is_dict and (found := _describe_invalid_scalar(key)):
            return (), f"key {found}"
        if isinstance(value, _CONTAINERS):
            if invalid := find_invalid_value(value, depth + 1):
                return (key, *invalid[0]), invalid[1]
        elif found := _describe_invalid_scalar(value):
            return (key,), found
    return None


def _describe_invalid_scalar(value: Any) -> str:
    if isinstance(value, str):
        return "" if value.isascii() or not _SURROGATE.search(value) else f"{value!r:.80} is not Unicode text"
    if isinstance(value, float):
        return "" if isfinite(value) else f"{value} is not a finite number"
    if isinstance(value, int):
        return "" if abs(value) < INTEGER_LIMIT else f"an integer of {value.bit_length()} bits"
    return "" if value is None else f"{value!r:.80} ({type(value).__name__})"


def load_yaml(path: Path) -> Any:
    """Read a YAML file of bounded size, depth and number of aliases; duplicate keys of a mapping are an error."""
    with _add_filename(path):
        text = read_text(path, YAML_LIMIT)
        try:
            return yaml.load(text, Loader=_LimitedLoader)  # noqa: S506  (a SafeLoader)
        except (yaml.YAMLError, ValueError, AttributeError, LookupError, TypeError, OverflowError) as error:
            raise DocumentError(_format_yaml_error(error)) from error


def _format_yaml_error(error: Exception) -> str:
    """Format an error of PyYAML as one line that starts with its place, without an excerpt of the file."""
    if isinstance(error, yaml.MarkedYAMLError) and (mark := error.problem_mark):
        return one_line(f"line {mark.line + 1}, column {mark.column + 1}: {error.problem}")
    return one_line(error)


def open_npz(path: Path, limit: int | None = None) -> Any:
    """Open an ``.npz`` file without pickled objects.

    Args:
        path: of the file.
        limit: maximum number of bytes of all arrays after decompression, and of the file; None: `ARRAYS_LIMIT`.

    Returns:
        NumPy's reader of the file, a context manager.

    Raises:
        Exception: one of `DAMAGED_FILE_ERRORS` if the file is damaged.
    """
    import numpy as np  # slow to import, and not needed by every command
    from numpy.lib.npyio import NpzFile

    limit = ARRAYS_LIMIT if limit is None else limit
    check_regular_file(path, limit)
    file = np.load(path, allow_pickle=False)
    if not isinstance(file, NpzFile):
        raise DocumentError("expected an .npz archive, found a single array")
    if file.zip is not None and sum(info.file_size for info in file.zip.infolist()) > limit:
        file.close()
        raise DocumentError(_describe_size(limit))
    return file


def load_npy(path: Path, limit: int = ARRAYS_LIMIT) -> Any:
    """Read an ``.npy`` file of at most ``limit`` bytes without pickled objects; raise one of `DAMAGED_FILE_ERRORS`."""
    import numpy as np  # slow to import, and not needed by every command

    check_regular_file(path, limit)
    array = np.load(path, allow_pickle=False)
    if not isinstance(array, np.ndarray):
        array.close()
        raise DocumentError("expected a single array, found an .npz archive")
    return array


def check_regular_file(path: Path, limit: int | None = None) -> None:
    """Raise DocumentError if a path is a pipe, device or socket, which may block, or a file over ``limit`` bytes."""
    status = path.stat()
    if not (stat.S_ISREG(status.st_mode) or stat.S_ISDIR(status.st_mode)):
        raise DocumentError("expected a regular file, found a pipe, device or socket")
    if limit is not None and status.st_size > limit:
        raise DocumentError(_describe_size(limit))


def read_bytes(path: Path, limit: int) -> bytes:
    """Read a file of at most ``limit`` bytes; raise DocumentError if it is larger or not a regular file."""
    with _add_filename(path):
        check_regular_file(path, limit)
        with path.open("rb") as file:
            content = file.read(limit + 1)
        if len(content) > limit:  # another process appends to it
            raise DocumentError(_describe_size(limit))
        return content


def read_text(path: Path, limit: int) -> str:
    """Read a UTF-8 text file of at most ``limit`` bytes."""
    with _add_filename(path):
        try:
            return read_bytes(path, limit).decode("utf-8")
        except UnicodeDecodeError as error:
            raise DocumentError(str(error)) from error


def _describe_size(limit: int) -> str:
    return f"the file has more than {limit >> 20} MB" if limit >= 2**20 else f"the file has more than {limit} bytes"


class _LimitedLoader(yaml.SafeLoader):
    """YAML loader that limits the number and the depth of values, and raises for duplicate keys of a mapping."""

    def __init__(self, stream: Any) -> None:
        super().__init__(stream)
        self._depth = self._nodes = 0
        self._sizes: dict[str, int] = {}  # anchor -> values below it

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        event: Any = self.peek_event()
        self._nodes += self._sizes.get(event.anchor, 0) if isinstance(event, yaml.AliasEvent) else 1
        if self._nodes > YAML_NODES:
            raise DocumentError(f"more than {YAML_NODES} values after expanding aliases")
        if self._depth >= YAML_DEPTH:
            raise DocumentError(_TOO_DEEP)
        before = self._nodes
        self._depth += 1
        node = super().compose_node(parent, index)
        self._depth -= 1
        if not isinstance(event, yaml.AliasEvent) and event.anchor is not None:
            self._sizes[event.anchor] = 1 + self._nodes - before
        return node

    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        """Compose a mapping; raise for a duplicate key."""
        node = super().compose_mapping_node(anchor)
        seen = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and (key.tag, key.value) in seen:
                raise yaml.MarkedYAMLError(None, None, f"duplicate key {key.value!r}", key.start_mark)
            seen.add((key.tag, str(key.value)))
        return node

    def construct_yaml_int(self, node: Any) -> int:
        number = INTEGER_LIMIT if len(node.value) > _INTEGER_LENGTH else super().construct_yaml_int(node)
        if abs(number) >= INTEGER_LIMIT:
            raise DocumentError(f"integer {node.value[:24]} has more than 64 bits")
        return number


_LimitedLoader.add_constructor("tag:yaml.org,2002:int", _LimitedLoader.construct_yaml_int)
