"""RoboCAS for ManiSkill3: importing this package registers its environments and its robot."""

import os as _os
from importlib import import_module as _import_module
from typing import TYPE_CHECKING as _TYPE_CHECKING

if _TYPE_CHECKING:
    from robocas_ms3.tasks.rl import rl_kwargs as rl_kwargs
    from robocas_ms3.tasks.vector import make_vec as make_vec

__version__ = "0.1.0"

_MODULES = {"make_vec": "robocas_ms3.tasks.vector", "rl_kwargs": "robocas_ms3.tasks.rl"}

if not _os.environ.get("ROBOCAS_DEFER_REGISTRATION"):
    from robocas_ms3 import tasks as _tasks  # noqa: F401


def __getattr__(name: str) -> object:
    if name in _MODULES:
        return getattr(_import_module(_MODULES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
