"""Registries of objects by name: the builtin ones, and those of installed packages (entry points)."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from functools import cached_property
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Any, TypeVar

from robocas_ms3.core.errors import ExtensionError
from robocas_ms3.core.signals import forbid_exit
from robocas_ms3.core.text import did_you_mean, format_error

_log = logging.getLogger(__name__)
T = TypeVar("T")


class Registry(Mapping[str, T]):
    """Objects by name. Entry points of other packages are loaded one by one, when they are asked for.

    Loading an entry point that fails raises an error; iterating leaves it out and logs one warning.

    Args:
        kind: what the objects are, for messages.
        group: of the entry points, such as ``robocas_ms3.tasks``. The name of an entry point is that of its object.
        type_: type of the objects.
        builtin: the objects of this package, which no other package can replace.
    """

    def __init__(self, kind: str, group: str, type_: Any, builtin: Mapping[str, T]) -> None:
        self.kind, self.group, self.type, self.builtin = kind, group, type_, dict(builtin)
        self._loaded: dict[str, T] = {}
        self._warned: set[str] = set()

    def __getitem__(self, name: str) -> T:
        if name in self.builtin:
            return self.builtin[name]
        if name not in self._loaded:
            self._loaded[name] = self._load(self.entry_points[name])
        return self._loaded[name]

    def __iter__(self) -> Iterator[str]:
        yield from self.builtin
        for name in self.entry_points:
            try:
                self[name]
            except ExtensionError as error:
                if name not in self._warned:
                    self._warned.add(name)
                    _log.warning("%s", error)
            else:
                yield name

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def find(self, name: str, *, where: object = "") -> T:
        """Return the object of a name; raise ExtensionError if it is unknown, or its entry point can't be loaded."""
        if name in self:
            return self[name]
        known = list(self)
        what, expected, fix = f"no such {self.kind}", f"one of {known}", did_you_mean(name, known)
        raise ExtensionError(what, where=where, expected=expected, found=repr(name), fix=fix)

    @cached_property
    def entry_points(self) -> dict[str, list[EntryPoint]]:
        """The entry points of other packages by name, not loaded; more than one where packages conflict."""
        found: dict[str, list[EntryPoint]] = {}
        for point in sorted(entry_points(group=self.group), key=lambda point: (point.name, package_of(point))):
            if point.name in self.builtin:
                _log.warning("a second %s %r, of %s, is left out", self.kind, point.name, point.value)
            elif point.value not in {other.value for other in found.setdefault(point.name, [])}:
                found[point.name].append(point)
        return found

    def _load(self, points: list[EntryPoint]) -> T:
        point, where = points[0], f"{points[0].name} = {points[0].value}"
        if len(points) > 1:
            what, packages = f"several packages have a {self.kind} of this name", ", ".join(map(package_of, points))
            raise ExtensionError(what, where=point.name, found=packages, fix="Uninstall all but one.")
        fix = f"Repair or uninstall {package_of(point)}."
        try:
            with forbid_exit(f"{self.kind} {where}"):
                found = point.load()
        except ExtensionError:
            raise
        except Exception as error:  # code of another package may raise anything
            what = f"this {self.kind} can't be loaded"
            raise ExtensionError(what, where=where, found=format_error(error), fix=fix) from error
        if not isinstance(found, self.type):
            expected, what = f"a {self.type.__name__}", f"not a {self.kind}"
            raise ExtensionError(what, where=where, expected=expected, found=type(found).__name__, fix=fix)
        return found


def package_of(point: EntryPoint) -> str:
    """Return the name of the package that declares an entry point."""
    return point.dist.name if point.dist else point.module.partition(".")[0]


def load_object(path: str) -> Any:
    """Return the object of an import path, ``package.module:name``; raise ExtensionError if there is none."""
    module, _, name = path.partition(":")
    try:
        with forbid_exit(path):
            return getattr(import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ExtensionError("no such object", where=path, expected="package.module:name", found=error) from error
