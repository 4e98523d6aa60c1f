"""RoboCASSelect-v1: grasp one of several identical objects, named by where it stands, and drop it into the basket."""

from __future__ import annotations

from mani_skill.utils.registration import register_env

from robocas_ms3.tasks.spec import SELECT
from robocas_ms3.tasks.transfer import TransferEnv


@register_env(SELECT.env_id, max_episode_steps=SELECT.max_episode_steps)
class RoboCASSelectEnv(TransferEnv):
    """Select: "the nearest soap", "the second soda can from the left", seen from the robot. The others are wrong.

    The relation is clear: what it compares differs from every other such object by at least 3 cm.
    """

    SPEC = SELECT
