"""Step back from what the gripper has just let go of, where it still stands against it."""

from __future__ import annotations

from robocas_ms3.errors import PlanningFailed
from robocas_ms3.planning.protocol import Array, Trajectory
from robocas_ms3.planning.skills.arm import Arm


def plan_step_back(arm: Arm, start: Array, goals: list[Array], *, try_free: bool = False) -> Trajectory:
    """Plan a straight line to the first of several TCP poses that one leads to, through whatever is touched.

    Args:
        arm: the attempt's tools.
        start: (7,) rad.
        goals: 4x4 in the arm's base frame, the best first.
        try_free: first look for a line that touches nothing of the planner's scene.

    Raises:
        PlanningFailed: none of them can be reached on a straight line.
    """
    if try_free:
        try:
            return arm.first_line(start, goals, stage="retreat")
        except PlanningFailed:
            pass
    return arm.first_line(start, goals, stage="retreat", check_collisions=False)
