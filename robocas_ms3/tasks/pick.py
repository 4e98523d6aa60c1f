"""RoboCASPick-v1: grasp the named object and drop it into the basket."""

from __future__ import annotations

from robocas_ms3.scenes.task_specs import PICK
from robocas_ms3.tasks.base import RoboCASEnv


class RoboCASPickEnv(RoboCASEnv):
    """Pick: the instruction names one of the objects on the support; it has to end up in the basket."""

    SPEC = PICK
