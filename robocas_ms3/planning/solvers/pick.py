"""Scripted policy of pick: grasp the target, lift it, carry it above the basket, release it, retreat."""

from __future__ import annotations

from robocas_ms3.planning.skills.arm import Arm
from robocas_ms3.planning.skills.base_placement import drive_and_grasp, place_in_basket


def attempt(arm: Arm) -> None:
    """Make one attempt at pick from the present state; raise PlanningError if it fails."""
    arm.start_subgoal("move and grasp")
    drive_and_grasp(arm, arm.target)
    arm.executor.check_open_loop()
    place_in_basket(arm, arm.target)
