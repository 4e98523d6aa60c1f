"""Read what may be damaged: what can be used of it, and what is wrong with the rest, for people."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

from robocas_ms3.core.documents import DAMAGED_FILE_ERRORS
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.text import format_error
from robocas_ms3.datasets.checks.scene import valid_values
from robocas_ms3.datasets.sources.files import SEE_VALIDATE

T = TypeVar("T")
_WRONG = (*DAMAGED_FILE_ERRORS, ArithmeticError, AttributeError, AssertionError, LookupError, RecursionError, TypeError)
"""Errors that values of another kind than expected raise."""


@contextmanager
def as_dataset_error(where: object) -> Iterator[None]:
    """Turn any error that damage may raise into a DatasetError that says where it is."""
    try:
        yield
    except _WRONG as error:
        what, found = "damaged, can't be shown", format_error(error)
        raise DatasetError(what, where=where, found=found, fix=SEE_VALIDATE) from error


def read_or_default(read: Callable[[], T], otherwise: T) -> tuple[T, str]:
    """Return the result and an empty text; if it can't be read, the other value and what is wrong."""
    try:
        with as_dataset_error(""):
            return read(), ""
    except DatasetError as error:
        return otherwise, reason(error)


def reason(error: DatasetError) -> str:
    """Return what is wrong according to an error, without the place."""
    return f"{error.what}, {error.found}" if str(error.found) else error.what


def join_reasons(*reasons: str) -> str:
    return "; ".join(dict.fromkeys(filter(None, reasons)))


def read_object(read: Callable[[], Any], name: str) -> tuple[dict[Any, Any], str]:
    """Return a JSON object of a dataset, and a note; an empty object if it is damaged."""
    try:
        with as_dataset_error(name):
            found = read()
    except DatasetError as error:
        return {}, f"`{name}` is damaged: {error.found}."
    return (found, "") if isinstance(found, dict) else ({}, f"`{name}` is damaged: it holds no object.")


def read_scene(read: Callable[[], Any], name: str) -> tuple[dict[str, Any], str]:
    """Return the valid values of a ``scene.json``, or of what has some of its keys, and what is wrong with the rest."""
    (found, wrong), failed = read_or_default(lambda: valid_values(read(), name), ({}, ""))
    return found, f"{name}: {failed}" if failed else wrong
