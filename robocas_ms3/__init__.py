"""RoboCAS for ManiSkill3: importing this package registers its environments with gymnasium.

Neither ManiSkill nor PyTorch is imported before an environment is made.
"""

from importlib import import_module as _import_module
from typing import TYPE_CHECKING as _TYPE_CHECKING

if _TYPE_CHECKING:
    from robocas_ms3.tasks.rl import rl_kwargs as rl_kwargs
    from robocas_ms3.tasks.vector import make_vec as make_vec

__version__ = "0.1.0"

_MODULES = {"make_vec": "robocas_ms3.tasks.vector", "rl_kwargs": "robocas_ms3.tasks.rl"}


def __getattr__(name: str) -> object:
    if name in _MODULES:
        return getattr(_import_module(_MODULES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


try:
    _import_module("gymnasium")
except ImportError:  # a broken gymnasium or numpy, which `robocas doctor` must survive to report it
    pass
else:  # at the end, as modules of other packages that are loaded here may import this one
    _import_module("robocas_ms3.registration").register_envs()
