"""RoboCAS for ManiSkill3: importing this package registers its environments and its robot."""

import os as _os

__version__ = "0.1.0"

if not _os.environ.get("ROBOCAS_DEFER_REGISTRATION"):
    from robocas_ms3 import tasks as _tasks  # noqa: F401
