"""Names from files that become parts of paths: a name must not lead out of the folder that it is used in."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator

from robocas_ms3.core.errors import RobocasError

LONGEST = 200
"""Bytes; file systems allow 255, of which temporary files add some."""
_EXPECTED = f"1 to {LONGEST} printable characters without / and \\, no leading dot"


def _checked(name: str) -> str:
    if not name.isprintable() or name.startswith(".") or {*name} & {"/", "\\"} or not 0 < len(name.encode()) <= LONGEST:
        raise ValueError(f"not a name for a file: expected {_EXPECTED}")
    return name


FileName = Annotated[str, AfterValidator(_checked)]
"""A field of a declared form that becomes a part of a path."""


def check_name(name: str, error: type[RobocasError], *, where: object, fix: str = "") -> str:
    """Return a name that can be that of one file or folder.

    Raises:
        RobocasError: ``error``: the name can't be used in a path.
    """
    try:
        return _checked(name)
    except ValueError as problem:
        found = f"{name!r:.80}"
        raise error(
            "this name can't be used for a file", where=where, expected=_EXPECTED, found=found, fix=fix
        ) from problem
