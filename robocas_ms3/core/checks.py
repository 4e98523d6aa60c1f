"""Checks of option values that do not import pydantic, which would slow down `robocas --help`."""

from __future__ import annotations

import math
import re

from robocas_ms3.core.errors import RobocasError

MAX_SEED = 2**32 - 1  # limit of `numpy.random.RandomState`, which ManiSkill uses


def check_number(option: str, value: float, minimum: float, maximum: int | None = None) -> None:
    """Raise RobocasError if the value of an option, such as ``--jobs``, is out of range; None: no maximum."""
    if not minimum <= value < math.inf or (maximum is not None and value > maximum):
        expected = f"at least {minimum}" if maximum is None else f"{minimum} to {maximum}"
        raise RobocasError("number out of range", where=option, expected=expected, found=value)


def parse_shard(text: str, error: type[RobocasError]) -> tuple[int, int]:
    """Parse the value ``K/N`` of ``--shard`` and return (K, N); raise ``error`` for another format or K >= N."""
    found = re.fullmatch(r"(\d{1,9})/(\d{1,9})", text)
    if not found or int(found[1]) >= int(found[2]):
        raise error("invalid shard", where="--shard", expected="K/N with K < N, such as 0/4", found=repr(text))
    return int(found[1]), int(found[2])
