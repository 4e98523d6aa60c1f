"""RoboCASSearch-v1: find a hidden object in a heap, clear what covers it, drop it into the basket."""

from __future__ import annotations

from mani_skill.utils.registration import register_env

from robocas_ms3.tasks.spec import SEARCH
from robocas_ms3.tasks.transfer import TransferEnv


@register_env(SEARCH.env_id, max_episode_steps=SEARCH.max_episode_steps)
class RoboCASSearchEnv(TransferEnv):
    """Search: the target is hidden in part (p_vis from above below ``target.max_visible_share``)."""

    SPEC = SEARCH
