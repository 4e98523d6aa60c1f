"""Make the paths of a command absolute when it starts: code that it calls may change the working directory."""

from __future__ import annotations

import os
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from robocas_ms3.core.errors import RobocasError
from robocas_ms3.core.paths import CACHE, DATA

_Config = TypeVar("_Config")


def with_absolute_paths(cfg: _Config) -> _Config:
    """Return a command's configuration with absolute paths, and make those of environment variables absolute.

    Raises:
        RobocasError: the working directory was removed, which libraries don't survive.
    """
    try:
        os.getcwd()
    except FileNotFoundError as error:
        raise RobocasError("the working directory was removed", fix="Change to a folder that exists.") from error
    for variable in (CACHE, DATA):
        if path := os.environ.get(variable):
            os.environ[variable] = str(Path(path).absolute())
    return _absolute(cfg)


def _absolute(value: Any) -> Any:
    if isinstance(value, Path):
        return value.absolute()
    if isinstance(value, tuple):
        return tuple(map(_absolute, value))
    if is_dataclass(value) and not isinstance(value, type):
        return replace(value, **{field.name: _absolute(getattr(value, field.name)) for field in fields(value)})
    return value
