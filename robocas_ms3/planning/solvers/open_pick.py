"""Scripted policy of open-pick: open the door or drawer, take the target out, carry it above the basket, let go."""

from __future__ import annotations

from robocas_ms3.errors import PlanningFailed
from robocas_ms3.language.templates import subgoal
from robocas_ms3.planning.skills.arm import Arm
from robocas_ms3.planning.skills.driving import drive_back, drive_to_reach
from robocas_ms3.planning.skills.grasping import grasp
from robocas_ms3.planning.skills.handles import open_part
from robocas_ms3.planning.skills.placing import carry_to_basket, release_into_basket

PLACES = 3  # to grasp from, where the base may move


def attempt(arm: Arm) -> None:
    """Try once, from wherever the episode stands; returns when the task has succeeded.

    Raises:
        PlanningFailed: with the stage that could not be done.
    """
    slot = int(arm.env.target_slot[0])
    words = arm.env.target_asset().asset.name, arm.env.task_config.support
    if not arm.env.task_stages()["furniture_opened"][0]:
        arm.executor.label(**subgoal("operate the target", *words))
        open_part(arm)
    arm.executor.label(**subgoal("move and grasp", *words))
    _take_out(arm, slot)
    arm.executor.label(**subgoal("transfer object", *words))
    drive_back(arm)
    carry_to_basket(arm, slot)
    release_into_basket(arm, slot)


def _take_out(arm: Arm, slot: int) -> None:
    """Grasp the target, from another place if no grasp can be planned from the first."""
    for place in range(PLACES):
        drive_to_reach(arm, slot, elsewhere=place > 0)
        length = len(arm.executor.actions)
        try:
            grasp(arm, slot)
            return
        except PlanningFailed:
            if len(arm.executor.actions) > length or not arm.executor.drives or place == PLACES - 1:
                raise
