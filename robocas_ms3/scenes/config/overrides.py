"""Overrides of configuration keys, as a command line has them: ``objects.count=12``."""

from __future__ import annotations

import re
from typing import Any

import yaml

from robocas_ms3.core.errors import RobocasError

_NULL = ("~", "null", "Null", "NULL")


class _Loader(yaml.SafeLoader):
    """Reads unquoted numbers with an exponent, such as ``3e-4``, as floats; YAML 1.1 reads them as strings."""


_EXPONENT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)[eE][-+]?[0-9]+$")
_Loader.add_implicit_resolver("tag:yaml.org,2002:float", _EXPONENT, list("-+.0123456789"))


def parse_override(text: str, error: type[RobocasError], example: str) -> dict[str, Any]:
    """Parse ``a.b=VALUE`` into ``{"a": {"b": VALUE}}``; the value is YAML.

    Unquoted numbers may have an exponent (``3e-4``). Quoted values are strings.

    Args:
        text: the override.
        error: error type to raise.
        example: a valid override, for the message.

    Raises:
        RobocasError: ``error``, if there is no key, no ``=``, or the value is empty or not YAML.
    """
    key, sign, word = text.partition("=")
    names = key.split(".")
    if not sign or not all(names) or key != key.strip():
        raise error("invalid override", where="--set", expected=f"KEY=VALUE, such as {example}", found=text)
    try:
        value: Any = yaml.load(word, Loader=_Loader)  # noqa: S506  (a SafeLoader)
    except (yaml.YAMLError, ValueError) as problem:
        raise error("invalid override: the value is not YAML", where="--set", found=text) from problem
    if value is None and word.strip() not in _NULL:
        fix = f"Write {key}=null to remove the key or to set it to null."
        raise error("invalid override: the value is empty", where="--set", expected="a value", found=text, fix=fix)
    first, *inner = names
    for name in reversed(inner):
        value = {name: value}
    return {first: value}
