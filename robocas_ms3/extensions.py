"""Tables of rows by name: the builtin ones, and those that installed packages bring by their entry points."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator, Mapping
from difflib import get_close_matches
from functools import cached_property
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Any, TypeVar

from robocas_ms3.errors import ExtensionError

_log = logging.getLogger(__name__)
T = TypeVar("T")


class Table(Mapping[str, T]):
    """Rows by name. What other packages bring is looked for when it is asked for, and loaded row by row.

    A row that can't be loaded is an error for who asks for it; who asks for all gets the others, and one warning. One
    whose module is just being imported is not there yet.

    Args:
        kind: what a row is, for messages.
        group: of the entry points, ``robocas_ms3.tasks``; each has the row's name, and names the object.
        row: type of a row.
        builtin: those of this package; no other package can replace them.
    """

    def __init__(self, kind: str, group: str, row: Any, builtin: Mapping[str, T]) -> None:
        self.kind, self.group, self.row, self.builtin = kind, group, row, dict(builtin)
        self._loaded: dict[str, T] = {}
        self._broken: dict[str, ExtensionError] = {}

    def __getitem__(self, name: str) -> T:
        if name in self.builtin:
            return self.builtin[name]
        point = self._points[name]
        if name in self._broken:
            raise self._broken[name].with_traceback(None)
        if name not in self._loaded:
            if _being_imported(point.module):
                raise KeyError(name)
            try:
                self._loaded[name] = self._load(point)
            except ExtensionError as error:
                self._broken[name] = error
                raise
        return self._loaded[name]

    def __iter__(self) -> Iterator[str]:
        yield from self.builtin
        for name in self._points:
            known = name in self._broken
            try:
                if name in self:
                    yield name
            except ExtensionError as error:
                if not known:
                    _log.warning("%s", error)

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def find(self, name: str, *, where: object = "") -> T:
        """The row of a name.

        Raises:
            ExtensionError: there is none, or it can't be loaded.
        """
        if name in self:
            return self[name]
        known = list(self)
        near = get_close_matches(name, known, n=3, cutoff=0.7)
        fix = f"Did you mean {' or '.join(near)}?" if near else ""
        raise ExtensionError(f"no such {self.kind}", where=where, expected=f"one of {known}", found=repr(name), fix=fix)

    @cached_property
    def _points(self) -> dict[str, EntryPoint]:
        found: dict[str, EntryPoint] = {}
        for point in sorted(entry_points(group=self.group), key=lambda point: (point.name, point.value)):
            if point.name in self.builtin or found.setdefault(point.name, point).value != point.value:
                _log.warning("a second %s %r, of %s, is left out", self.kind, point.name, point.value)
        return found

    def _load(self, point: EntryPoint) -> T:
        fix = f"Mend or uninstall {point.dist.name}." if point.dist else ""
        try:
            row = point.load()
        except Exception as error:  # whatever another package's module meets
            what, found = f"this {self.kind} can't be loaded", f"{type(error).__name__}: {error}"
            raise ExtensionError(what, where=f"{point.name} = {point.value}", found=found, fix=fix) from error
        if not isinstance(row, self.row):
            expected = f"a {self.row.__name__}"
            where = f"{point.name} = {point.value}"
            raise ExtensionError(f"no {self.kind}", where=where, expected=expected, found=type(row).__name__, fix=fix)
        return row


def _being_imported(module: str) -> bool:
    """Whether a module is half imported: it is what imports us."""
    return getattr(getattr(sys.modules.get(module), "__spec__", None), "_initializing", False)


def load(path: str) -> Any:
    """The object of an import path, ``package.module:name``.

    Raises:
        ExtensionError: there is none.
    """
    module, _, name = path.partition(":")
    try:
        return getattr(import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ExtensionError("no such object", where=path, expected="package.module:name", found=error) from error
