"""Scripted policy of pick: grasp the target, lift it, carry it above the basket, let go, step back."""

from __future__ import annotations

from robocas_ms3.planning.skills.arm import Arm
from robocas_ms3.planning.skills.placing import carry_to_basket, release_into_basket
from robocas_ms3.planning.skills.stance import drive_to_basket, grasp_from_reach
from robocas_ms3.scenes.language.templates import subgoal


def attempt(arm: Arm) -> None:
    """Try once, from wherever the episode stands; returns when the task has succeeded."""
    slot = int(arm.env.target_slot[0])
    words = arm.env.target_asset().asset.name, arm.env.task_config.support
    arm.executor.label(**subgoal("move and grasp", *words))
    grasp_from_reach(arm, slot)
    arm.executor.rehearse()
    arm.executor.label(**subgoal("transfer object", *words))
    drive_to_basket(arm, slot)
    carry_to_basket(arm, slot)
    release_into_basket(arm, slot)
