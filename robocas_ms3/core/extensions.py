"""Tables of rows by name: the builtin ones, and those that installed packages bring by their entry points."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from difflib import get_close_matches
from functools import cached_property
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Any, TypeVar

from robocas_ms3.core.after_import import half_imported
from robocas_ms3.core.errors import ExtensionError
from robocas_ms3.core.exits import no_exit

_log = logging.getLogger(__name__)
T = TypeVar("T")


class Table(Mapping[str, T]):
    """Rows by name. What other packages bring is looked for when it is asked for, and loaded row by row.

    A row that can't be loaded, or that several packages have, is an error for who asks for it; who asks for all gets
    the others, and one warning. One whose module is just being imported is not there yet (`unfinished`).

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
        points = self.points[name]
        if name in self._broken:
            raise self._broken[name].with_traceback(None)
        if name not in self._loaded:
            if half_imported(points[0].module):
                raise KeyError(name)
            try:
                self._loaded[name] = self._load(points)
            except ExtensionError as error:
                self._broken[name] = error
                raise
        return self._loaded[name]

    def __iter__(self) -> Iterator[str]:
        yield from self.builtin
        for name in self.points:
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
    def points(self) -> dict[str, list[EntryPoint]]:
        """By name, the entry points of other packages, of which nothing is loaded; one each, if all is well."""
        found: dict[str, list[EntryPoint]] = {}
        for point in sorted(entry_points(group=self.group), key=lambda point: (point.name, package_of(point))):
            if point.name in self.builtin:
                _log.warning("a second %s %r, of %s, is left out", self.kind, point.name, point.value)
            elif point.value not in {other.value for other in found.setdefault(point.name, [])}:
                found[point.name].append(point)
        return found

    def unfinished(self) -> list[str]:
        """Modules of rows that are not there yet, as their import has not ended."""
        modules = [points[0].module for name, points in self.points.items() if name not in self._loaded]
        return [module for module in dict.fromkeys(modules) if half_imported(module)]

    def _load(self, points: list[EntryPoint]) -> T:
        point = points[0]
        if len(points) > 1:
            what, packages = f"several packages have a {self.kind} of this name", ", ".join(map(package_of, points))
            raise ExtensionError(what, where=point.name, found=packages, fix="Uninstall all but one.")
        fix = f"Mend or uninstall {package_of(point)}."
        try:
            with no_exit(f"{self.kind} {point.name} = {point.value}"):
                row = point.load()
        except ExtensionError:
            raise
        except Exception as error:  # whatever another package's module meets
            what, found = f"this {self.kind} can't be loaded", " ".join(f"{type(error).__name__}: {error}".split())
            raise ExtensionError(what, where=f"{point.name} = {point.value}", found=found, fix=fix) from error
        if not isinstance(row, self.row):
            expected = f"a {self.row.__name__}"
            where = f"{point.name} = {point.value}"
            raise ExtensionError(f"no {self.kind}", where=where, expected=expected, found=type(row).__name__, fix=fix)
        return row


def package_of(point: EntryPoint) -> str:
    """Name of the package that has an entry point."""
    return point.dist.name if point.dist else point.module.partition(".")[0]


def load(path: str) -> Any:
    """The object of an import path, ``package.module:name``.

    Raises:
        ExtensionError: there is none.
    """
    module, _, name = path.partition(":")
    try:
        with no_exit(path):
            return getattr(import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ExtensionError("no such object", where=path, expected="package.module:name", found=error) from error
