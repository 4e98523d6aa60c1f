"""Registries of named objects: builtin objects, and entry points of installed packages."""

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
    """A read-only mapping of names to objects; an entry point of another package is loaded at its first use.

    Access to an entry point that cannot be loaded raises an error. Iteration skips it and logs one warning.

    Args:
        kind: noun that names an object in messages, such as ``planner``.
        group: group of the entry points, such as ``robocas_ms3.tasks``. The name of an entry point is the name of its
            object in the registry.
        type_: required type of the objects.
        builtin: objects of this package by name; other packages cannot replace them.
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

    def find(self, name: str, *, where: object = "", usage: bool = True) -> T:
        """Return an object by name; raise ExtensionError if the name is unknown or its entry point cannot be loaded.

        ``usage``: whether the user passed the name; False if a file contains it (`RobocasError.usage`).
        """
        if name in self:
            return self[name]
        known = list(self)
        what, expected, fix = f"no such {self.kind}", f"one of {', '.join(known)}", did_you_mean(name, known)
        raise ExtensionError(what, where=where, expected=expected, found=repr(name), fix=fix, usage=usage)

    @cached_property
    def entry_points(self) -> dict[str, list[EntryPoint]]:
        """Entry points of other packages by name, not loaded; a name has several if packages conflict."""
        found: dict[str, list[EntryPoint]] = {}
        for point in sorted(entry_points(group=self.group), key=lambda point: (point.name, package_name(point))):
            if point.name in self.builtin:
                _log.warning(
                    "ignored %s %r of %s: this name belongs to a %s of robocas_ms3. Rename the entry point.",
                    *(self.kind, point.name, point.value, self.kind),
                )
            elif point.value not in {other.value for other in found.setdefault(point.name, [])}:
                found[point.name].append(point)
        return found

    def _load(self, points: list[EntryPoint]) -> T:
        point, where = points[0], f"{points[0].name} = {points[0].value}"
        if len(points) > 1:
            what, packages = (
                f"several packages define a {self.kind} with this name",
                ", ".join(map(package_name, points)),
            )
            raise ExtensionError(what, where=point.name, found=packages, fix="Uninstall all of these packages but one.")
        fix = f"Repair or uninstall {package_name(point)}."
        try:
            with forbid_exit(f"{self.kind} {where}"):
                found = point.load()
        except ExtensionError:
            raise
        except Exception as error:  # code of another package may raise any error
            what = f"cannot load this {self.kind}"
            raise ExtensionError(what, where=where, found=format_error(error), fix=fix) from error
        if not isinstance(found, self.type):
            expected, what = f"a {self.type.__name__}", f"invalid {self.kind}"
            raise ExtensionError(what, where=where, expected=expected, found=type(found).__name__, fix=fix)
        return found


def package_name(point: EntryPoint) -> str:
    """Return the name of the installed package that declares an entry point."""
    return point.dist.name if point.dist else point.module.partition(".")[0]


def import_object(path: str) -> Any:
    """Import the object at ``package.module:name``; raise ExtensionError if that fails."""
    module, _, name = path.partition(":")
    try:
        with forbid_exit(path):
            return getattr(import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ExtensionError(
            "cannot import this object", where=path, expected="package.module:name", found=error
        ) from error
