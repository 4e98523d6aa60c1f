"""Reading of data that may be damaged: usable content, and a text on the damage."""

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
def as_dataset_error(where: object) -> Iterator[None]:
    """Convert errors of damaged data to DatasetError with the place ``where``."""
    try:
        yield
    except _WRONG as error:
        what, found = "damaged data", format_error(error)
        raise DatasetError(what, where=where, found=found, fix=SEE_VALIDATE) from error


def read_or_default(read: Callable[[], T], otherwise: T) -> tuple[T, str]:
    """Return the result of ``read`` and an empty text, or ``otherwise`` and the reason of the failure."""
    try:
        with as_dataset_error(""):
            return read(), ""
    except DatasetError as error:
        return otherwise, reason(error)


def reason(error: DatasetError) -> str:
    """Return the message of an error without the place."""
    return f"{error.what}, {error.found}" if str(error.found) else error.what


def join_reasons(*reasons: str) -> str:
    """Join distinct, non-empty reasons to one text."""
    return "; ".join(dict.fromkeys(filter(None, reasons)))


def read_object(read: Callable[[], Any], name: str) -> tuple[dict[Any, Any], str]:
    """Return a JSON object of a dataset and an empty note; for a damaged one an empty object and a note."""
    try:
        with as_dataset_error(name):
            found = read()
    except DatasetError as error:
        return {}, f"`{name}` is damaged: {error.found}."
    return (found, "") if isinstance(found, dict) else ({}, f"`{name}` is damaged: not a JSON object.")


def read_scene(read: Callable[[], Any], name: str) -> tuple[dict[str, Any], str]:
    """Return the valid values of an object with keys of ``scene.json``, and a text on invalid values."""
    (found, wrong), failed = read_or_default(lambda: read_valid_values(read(), name), ({}, ""))
    return found, f"{name}: {failed}" if failed else wrong
