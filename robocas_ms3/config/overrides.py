"""Overrides of configuration keys, as a command line has them: ``objects.count=12``."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import yaml

from robocas_ms3.errors import RobocasError


def parse_override(text: str, error: type[RobocasError], example: str) -> dict[str, Any]:
    """Parse ``a.b=VALUE`` into ``{"a": {"b": VALUE}}``; the value is YAML.

    Args:
        text: the override.
        error: error type to raise.
        example: a valid override, for the message.

    Raises:
        RobocasError: ``error``, if there is no key, no ``=``, or the value is not YAML.
    """
    key, sign, word = text.partition("=")
    names = key.split(".")
    if not sign or not all(names) or key != key.strip():
        raise error("invalid override", where="--set", expected=f"KEY=VALUE, such as {example}", found=text)
    try:
        value: Any = yaml.safe_load(word)
    except (yaml.YAMLError, ValueError) as problem:
        raise error("invalid override: the value is not YAML", where="--set", found=text) from problem
    if isinstance(value, str):  # YAML 1.1 reads 3e-4 as a string
        with suppress(ValueError):
            value = float(value)
    first, *inner = names
    for name in reversed(inner):
        value = {name: value}
    return {first: value}
