"""Seeds as files have them."""

from __future__ import annotations

from typing import Any

GREATEST_SEED = 2**32 - 1  # numpy's older generators, which ManiSkill uses, take no greater one


def one_seed(value: Any) -> int | None:
    """A seed as an integer; ManiSkill writes a list of one. None where it is neither."""
    if isinstance(value, list) and len(value) == 1:
        value = value[0]
    return value if type(value) is int else None
