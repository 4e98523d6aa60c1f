"""RoboCASPick-v1: grasp the named object and drop it into the basket."""

from __future__ import annotations

from mani_skill.utils.registration import register_env

from robocas_ms3.tasks.learning import LearningEnv
from robocas_ms3.tasks.spec import PICK


@register_env(PICK.env_id, max_episode_steps=PICK.max_episode_steps)
class RoboCASPickEnv(LearningEnv):
    """Pick: the instruction names one of the objects on the support; it has to end up in the basket."""

    SPEC = PICK
