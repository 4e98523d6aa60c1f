"""RoboCASPick-v1: grasp the named object and put it into the basket."""

from __future__ import annotations

from robocas_ms3.scenes.task_specs import PICK
from robocas_ms3.tasks.base import RoboCASEnv


class RoboCASPickEnv(RoboCASEnv):
    """Pick the object that the instruction names, and put it into the basket."""

    SPEC = PICK
