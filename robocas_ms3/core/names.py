"""Names from files that become parts of paths: a name must not lead out of the folder that it is used in."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator

from robocas_ms3.core.errors import RobocasError

LONGEST = 200
"""Bytes; file systems allow 255, of which temporary files add some."""


_EXPECTED = f"1 to {LONGEST} printable characters without / and \\, no leading dot"


def is_name(name: object) -> bool:
    """Whether a value can be the name of one file or folder: no separators, no leading dot, printable, not too long."""
    if not isinstance(name, str) or not name.isprintable() or name.startswith("."):
        return False
    return 0 < len(name.encode()) <= LONGEST and "/" not in name and "\\" not in name


def check_name(name: object, error: type[RobocasError], *, where: object, fix: str = "") -> str:
    """Return a name that can be that of one file or folder.

    Args:
        name: as a file has it.
        error: to be raised.
        where: the name is from, for messages.
        fix: for messages.

    Raises:
        RobocasError: ``error``: the name can't be used in a path.
    """
    if not is_name(name):
        found = repr(name) if len(repr(name)) <= 80 else f"{repr(name)[:77]}..."
        raise error("this name can't be used for a file", where=where, expected=_EXPECTED, found=found, fix=fix)
    return str(name)


def _checked(name: str) -> str:
    if not is_name(name):
        raise ValueError(f"not a name for a file: expected {_EXPECTED}")
    return name


FileName = Annotated[str, AfterValidator(_checked)]
"""A field of a declared form that becomes a part of a path."""
