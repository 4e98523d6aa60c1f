"""Reads what may be damaged: what can be used of it, and what is wrong with the rest, in words for people."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, TypeVar

from robocas_ms3.core.documents import DAMAGED
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets.checks.scene import sound
from robocas_ms3.datasets.checks.violation import check_form
from robocas_ms3.datasets.sources.records import RateRecord

T = TypeVar("T")
_WRONG = (*DAMAGED, ArithmeticError, AttributeError, AssertionError, LookupError, RecursionError, TypeError)
"""What comes of values of another kind than expected."""


@contextmanager
def readable(where: object) -> Iterator[None]:
    """Turn whatever damage may raise into an error that says where it is.

    Raises:
        DatasetError: something could not be read.
    """
    try:
        yield
    except _WRONG as error:
        text = str(error).strip().splitlines()
        found = f"{type(error).__name__}: {text[0]}" if text else type(error).__name__
        fix = "robocas validate says what is wrong."
        raise DatasetError("damaged, can't be shown", where=where, found=found, fix=fix) from error


def attempt(read: Callable[[], T], otherwise: T) -> tuple[T, str]:
    """What can be read and nothing, else the other value and what is wrong."""
    try:
        with readable(""):
            return read(), ""
    except DatasetError as error:
        return otherwise, reason(error)


def reason(error: DatasetError) -> str:
    """What an error says of what is wrong, without where."""
    return f"{error.what}, {error.found}" if str(error.found) else error.what


def together(*said: str) -> str:
    """What is wrong, each thing once."""
    kept: list[str] = []
    for text in said:
        if not any(text in other for other in kept):
            kept.append(text)
    return "; ".join(filter(None, kept))


def table(read: Callable[[], Any], name: str) -> tuple[dict[Any, Any], str]:
    """A JSON object of a dataset; empty where it is damaged, with the reason."""
    try:
        with readable(name):
            found = read()
    except DatasetError as error:
        return {}, f"`{name}` is damaged: {error.found}."
    return (found, "") if isinstance(found, dict) else ({}, f"`{name}` is damaged: it holds no object.")


def scene(read: Callable[[], Any], name: str) -> tuple[dict[str, Any], str]:
    """A ``scene.json``, or what else has some of its keys, without the values that are wrong, and those in words."""
    (found, wrong), failed = attempt(lambda: sound(read(), name), ({}, ""))
    return found, f"{name}: {failed}" if failed else wrong


def rate_of(settings: Mapping[str, Any], name: str, default: float) -> tuple[float, str]:
    """Steps a second, and what is wrong with what the settings say of it."""
    wrong = check_form(RateRecord, settings, "")
    if not wrong:
        return float(settings["rate_hz"]), ""
    said = f"`rate_hz` of `{name}`: expected {wrong[0].expected}, found {wrong[0].found}; {default:g} Hz is assumed."
    return default, said if "rate_hz" in settings else ""


def split_of(info: Mapping[str, Any]) -> dict[int, str]:
    """Side of each episode that a dataset lists, "train" or "val"; the others are on neither."""
    sides = {side: info.get(f"{side}_eps") for side in ("train", "val")}
    return {n: side for side, listed in sides.items() if isinstance(listed, list) for n in listed if type(n) is int}


def without_nan(value: Any) -> Any:
    """The same with None where a number is not finite, as JSON knows no other."""
    if isinstance(value, dict):
        return {key: without_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
