"""Read data that may be damaged: return the usable content, and a text that describes the damage."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

from robocas_ms3.core.documents import DAMAGED_FILE_ERRORS
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.text import format_error
from robocas_ms3.datasets.checks.scene import read_valid_values
from robocas_ms3.datasets.sources.files import SEE_VALIDATE

T = TypeVar("T")
_WRONG = (*DAMAGED_FILE_ERRORS, ArithmeticError, AttributeError, AssertionError, LookupError, RecursionError, TypeError)
"""Errors that damaged files and invalid values raise."""


@contextmanager
def convert_damage_errors(where: object) -> Iterator[None]:
    """Convert the errors that damaged data raise to DatasetError; ``where`` is the file or episode."""
    try:
        yield
    except _WRONG as error:
        what, found = "damaged data", format_error(error)
        raise DatasetError(what, where=where, found=found, fix=SEE_VALIDATE) from error


def read_or_default(read: Callable[[], T], otherwise: T) -> tuple[T, str]:
    """Call ``read``; return its result and "", or ``otherwise`` and a text on the damage if the data are damaged."""
    try:
        with convert_damage_errors(""):
            return read(), ""
    except DatasetError as error:
        return otherwise, describe_error(error)


def describe_error(error: DatasetError) -> str:
    """Return the message of an error without the file or episode."""
    return f"{error.what}, {error.found}" if str(error.found) else error.what


def join_reasons(*reasons: str) -> str:
    """Join the distinct, non-empty reasons, separated by semicolons."""
    return "; ".join(dict.fromkeys(filter(None, reasons)))


def read_object(read: Callable[[], Any], name: str) -> tuple[dict[Any, Any], str]:
    """Read a JSON object; return the object and "", or {} and a note for the page if the object is damaged."""
    try:
        with convert_damage_errors(name):
            found = read()
    except DatasetError as error:
        return {}, f"`{name}` is damaged: {error.found}."
    return (found, "") if isinstance(found, dict) else ({}, f"`{name}` is damaged: not a JSON object.")


def read_scene(read: Callable[[], Any], name: str) -> tuple[dict[str, Any], str]:
    """Read an object with keys of ``scene.json``; return the valid values, and a text on invalid values."""
    (found, wrong), failed = read_or_default(lambda: read_valid_values(read(), name), ({}, ""))
    return found, f"{name}: {failed}" if failed else wrong
