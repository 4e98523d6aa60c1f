"""Scripted policy of open_pick: open the door or drawer, then run the policy of pick."""

from __future__ import annotations

from robocas_ms3.planning.skills.arm import Arm
from robocas_ms3.planning.skills.base_placement import drive_and_open
from robocas_ms3.planning.skills.handles import is_opened
from robocas_ms3.planning.solvers import pick


def attempt(arm: Arm) -> None:
    """Make one attempt at open_pick from the present state; raise PlanningError if it fails."""
    if not is_opened(arm):
        arm.start_subgoal("operate the target")
        drive_and_open(arm)
        arm.executor.check_open_loop()
        arm.add_backtracking_point()
    pick.attempt(arm)
