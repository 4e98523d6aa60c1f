"""Scripted policy of pick: grasp the target, lift it, carry it above the basket, release it, retreat."""

from __future__ import annotations

from robocas_ms3.core.errors import PlanningError
from robocas_ms3.planning.skills.arm import Arm
from robocas_ms3.planning.skills.base_placement import drive_and_grasp, place_in_basket
from robocas_ms3.planning.skills.make_room import can_make_room, make_room


def attempt(arm: Arm) -> None:
    """Make one attempt at pick from the present state; raise PlanningError if it fails."""
    arm.start_subgoal("move and grasp")
    done = len(arm.executor.actions)
    try:
        drive_and_grasp(arm, arm.target)
    except PlanningError as error:
        if len(arm.executor.actions) > done or error.reason == "unreachable" or not can_make_room(arm):
            raise
        make_room(arm, arm.target)
        arm.executor.check_open_loop()
        arm.add_backtracking_point()
        drive_and_grasp(arm, arm.target)
    arm.executor.check_open_loop()
    place_in_basket(arm, arm.target)
