"""Checks of options, without pydantic, for which `robocas --help` does not wait."""

from __future__ import annotations

import math
import re

from robocas_ms3.core.errors import RobocasError

MAX_SEED = 2**32 - 1  # numpy's older generators, which ManiSkill uses, take no greater one


def check_number(where: str, value: float, least: float, greatest: int | None = None) -> None:
    """Raise RobocasError if a number, such as that of an option ``--jobs``, is out of its range."""
    if not least <= value < math.inf or (greatest is not None and value > greatest):
        expected = f"at least {least}" if greatest is None else f"{least} to {greatest}"
        raise RobocasError("this number is out of range", where=where, expected=expected, found=value)


def parse_shard(text: str, error: type[RobocasError]) -> tuple[int, int]:
    """Return K and N of ``K/N``; raise ``error`` if the text has another form, or K is not less than N."""
    found = re.fullmatch(r"(\d{1,9})/(\d{1,9})", text)
    if not found or int(found[1]) >= int(found[2]):
        raise error("invalid shard", where="--shard", expected="K/N with K < N, such as 0/4", found=repr(text))
    return int(found[1]), int(found[2])
