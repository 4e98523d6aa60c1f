"""RoboCAS for ManiSkill3: importing this package tells gymnasium of its environments, and loads nothing heavy.

Where gymnasium is not imported yet, it is told when it is. Making an environment imports ManiSkill and tells it of the
robot, as ``import robocas_ms3.tasks`` does.
"""

from importlib import import_module as _import_module
from typing import TYPE_CHECKING as _TYPE_CHECKING

from robocas_ms3.core.after_import import after_import as _after_import

if _TYPE_CHECKING:
    from robocas_ms3.tasks.rl import rl_kwargs as rl_kwargs
    from robocas_ms3.tasks.vector import make_vec as make_vec

__version__ = "0.1.0"

_MODULES = {"make_vec": "robocas_ms3.tasks.vector", "rl_kwargs": "robocas_ms3.tasks.rl"}


def _register() -> None:
    from robocas_ms3.registration import register

    register()


def __getattr__(name: str) -> object:
    if name in _MODULES:
        return getattr(_import_module(_MODULES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


_after_import("gymnasium", _register)  # the last: packages that bring tasks may import this one
