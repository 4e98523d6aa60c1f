"""JSON and YAML files of others, bounded before anything is built of them: a small file must not take all memory.

And what NumPy says of damaged files of arrays.

What is wrong with a file is a `DocumentError`, and thereby a ``ValueError``; that it can't be read an ``OSError``.
"""

from __future__ import annotations

import json
import tokenize
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from math import isfinite
from pathlib import Path
from typing import Any

import yaml

JSON_LIMIT = 256 * 2**20
"""Bytes: a hundred thousand recordings have 230 MB of it."""
YAML_LIMIT = 4 * 2**20
ARRAYS_LIMIT = 2**31
"""Bytes that the arrays of an ``.npz`` may have: compressed, they can be a thousandth of that."""
YAML_DEPTH = 64
YAML_NODES = 500_000
"""Values, those that aliases stand for counted each time: nine aliases of nine aliases of ... are a billion."""

DAMAGED = (
    *(OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error),
    NotImplementedError,  # damaged flags or method of an archive's member
    *(SyntaxError, tokenize.TokenError),  # an array's header
    MemoryError,  # and one that says it is larger than anything
)
"""What NumPy raises for damaged arrays and archives."""


class DocumentError(ValueError):
    """A file that is too large, nested too deeply, or not of its language; in one line.

    Attributes:
        filename: of the file, as errors of the system have it; empty where a text was read.
    """

    filename: str = ""


@contextmanager
def _of(path: Path) -> Iterator[None]:
    try:
        yield
    except DocumentError as error:
        error.filename = str(path)
        raise


def load_json(path: Path) -> Any:
    """Read a JSON file.

    Raises:
        DocumentError: it is no JSON, or too large or deep, or a number in it is not finite.
        OSError: it can't be read.
    """
    with _of(path):
        return json_values(_text(path, JSON_LIMIT))


def json_values(text: str | bytes) -> Any:
    """Values of a text of JSON. It knows no NaN and no infinity, whatever Python's own reader takes.

    Raises:
        DocumentError: it is no JSON, or too deep, or a number in it is not finite.
    """
    try:
        return json.loads(text, parse_constant=_no_number, parse_float=_finite)
    except ValueError as error:
        raise DocumentError(str(error)) from error
    except RecursionError as error:
        raise DocumentError("nested too deeply") from error


def load_yaml(path: Path) -> Any:
    """Read a YAML file; a key given twice in a mapping is an error.

    Raises:
        DocumentError: it is no YAML, or too large or deep, or its aliases stand for too much.
        OSError: it can't be read.
    """
    with _of(path):
        text = _text(path, YAML_LIMIT)
        try:
            return yaml.load(text, Loader=_Loader)  # noqa: S506  (a SafeLoader)
        except (yaml.YAMLError, ValueError, AttributeError, LookupError, TypeError) as error:
            raise DocumentError(" ".join(str(error).split())) from error


def open_arrays(path: Path) -> Any:
    """Open an ``.npz``; NumPy's reader of it, for a ``with`` statement, which makes no objects of Python's.

    Raises:
        ValueError: or another of `DAMAGED`: it is none, or its arrays are too large.
    """
    import numpy as np  # not for every command
    from numpy.lib.npyio import NpzFile

    file = np.load(path, allow_pickle=False)
    if not isinstance(file, NpzFile):
        raise DocumentError("one array, not an archive of several")
    if file.zip is not None and sum(info.file_size for info in file.zip.infolist()) > ARRAYS_LIMIT:
        file.close()
        raise DocumentError(f"more than {ARRAYS_LIMIT >> 20} MB of arrays")
    return file


def _no_number(word: str) -> float:
    raise DocumentError(f"{word} is no number of JSON")


def _finite(word: str) -> float:
    number = float(word)
    return number if isfinite(number) else _no_number(word[:40])


def _text(path: Path, limit: int) -> str:
    with path.open("rb") as file:
        content = file.read(limit + 1)
    if len(content) > limit:
        raise DocumentError(f"more than {limit >> 20} MB")
    try:
        return content.decode("utf-8")
    except UnicodeDecodeError as error:
        raise DocumentError(str(error)) from error


class _Loader(yaml.SafeLoader):
    """Counts what it composes, and takes no key twice."""

    def __init__(self, stream: Any) -> None:
        super().__init__(stream)
        self._depth = self._nodes = 0
        self._sizes: dict[str, int] = {}  # anchor -> values below it

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """Compose a value and what is in it."""
        event: Any = self.peek_event()
        self._nodes += self._sizes.get(event.anchor, 0) if isinstance(event, yaml.AliasEvent) else 1
        if self._nodes > YAML_NODES:
            raise DocumentError(f"more than {YAML_NODES} values, with those that aliases stand for")
        if self._depth >= YAML_DEPTH:
            raise DocumentError(f"nested more than {YAML_DEPTH} deep")
        before = self._nodes
        self._depth += 1
        node = super().compose_node(parent, index)
        self._depth -= 1
        if not isinstance(event, yaml.AliasEvent) and event.anchor is not None:
            self._sizes[event.anchor] = 1 + self._nodes - before
        return node

    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        """Compose a mapping, refusing repeated keys."""
        node = super().compose_mapping_node(anchor)
        seen = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and (key.tag, key.value) in seen:
                raise yaml.MarkedYAMLError(None, None, f"the key {key.value!r} is given twice", key.start_mark)
            seen.add((key.tag, str(key.value)))
        return node
