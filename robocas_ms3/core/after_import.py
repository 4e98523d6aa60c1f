"""Do something once a module has been imported, whoever imports it, without importing it."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from types import ModuleType

_CALLS = "_robocas_ms3_calls"  # of a spec, what follows its import


def after_import(name: str, then: Callable[[], None]) -> None:
    """Call a function once the module of a name is there: now, or right after its import, which may have begun."""
    half = half_imported(name)
    if half:
        _follow(half, then)
    elif name in sys.modules:
        then()
    else:
        sys.meta_path.insert(0, _Waiting(name, then))


def half_imported(name: str) -> str:
    """The module of a name, or the outermost of its packages, whose import has begun and not ended; empty: none."""
    parts = name.split(".")
    names = (".".join(parts[: count + 1]) for count in range(len(parts)))
    return next((one for one in names if getattr(_spec(one), "_initializing", False)), "")


def _spec(name: str) -> ModuleSpec | None:
    return getattr(sys.modules.get(name), "__spec__", None)


def _follow(name: str, then: Callable[[], None]) -> None:
    """Let a call follow the end of an import that has begun; it comes once, and only if the import ends well."""
    spec = _spec(name)
    if type(spec) is ModuleSpec:
        spec.__class__ = _Unfinished
        spec.__dict__[_CALLS] = []
    if isinstance(spec, _Unfinished) and then not in spec.__dict__[_CALLS]:
        spec.__dict__[_CALLS].append(then)


class _Unfinished(ModuleSpec):
    """The spec of a half imported module: importlib writes there that it is through, and nowhere else."""

    @property
    def _initializing(self) -> bool:
        return self.__dict__["_initializing"]

    @_initializing.setter
    def _initializing(self, value: bool) -> None:
        self.__dict__["_initializing"] = value
        if not value:
            self.__class__ = ModuleSpec  # pyright: ignore[reportAttributeAccessIssue]
            for then in self.__dict__.pop(_CALLS):
                if self.name in sys.modules:  # else its import has failed
                    then()


class _Waiting(MetaPathFinder):
    """Finds one module, as the others would, and lets a call follow its execution."""

    def __init__(self, name: str, then: Callable[[], None]) -> None:
        self._name, self._then = name, then

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """The module's own spec, whose loader calls; None for any other module."""
        if fullname != self._name:
            return None
        sys.meta_path.remove(self)
        spec = find_spec(fullname)
        if spec is None or spec.loader is None:
            return spec
        execute = spec.loader.exec_module

        def execute_and_call(module: ModuleType) -> None:
            execute(module)
            self._then()

        spec.loader.exec_module = execute_and_call
        return spec
