"""RoboCAS for ManiSkill3: importing this package registers its environments and its robot."""

import os as _os
from typing import TYPE_CHECKING as _TYPE_CHECKING

if _TYPE_CHECKING:
    from robocas_ms3.tasks.vector import make_vec as make_vec

__version__ = "0.1.0"

if not _os.environ.get("ROBOCAS_DEFER_REGISTRATION"):
    from robocas_ms3 import tasks as _tasks  # noqa: F401


def __getattr__(name: str) -> object:
    if name == "make_vec":
        from robocas_ms3.tasks.vector import make_vec

        return make_vec
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
