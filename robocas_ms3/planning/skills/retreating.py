"""Step back from what the gripper has just let go of, where it still stands against it; back out of what failed."""

from __future__ import annotations

from robocas_ms3.core.errors import PlanningFailed
from robocas_ms3.planning.protocol import Array, Trajectory
from robocas_ms3.planning.skills.arm import Arm, moved_back

BACK_OUT_RISE = 0.10  # m
BACK_OUT = (0.25, 0.15, 0.10, 0.06)  # m against the approach; the first one to which the way is free
POINTS_DOWN = -0.7  # upright component of an approach that is rather from above than level


def plan_step_back(
    arm: Arm, start: Array, goals: list[Array], *, try_free: bool = False, only_free: bool = False
) -> Trajectory:
    """Plan a straight line to the first of several TCP poses (best first), through whatever is touched.

    With ``try_free`` a line that touches nothing comes first; with ``only_free`` no other is taken.
    """
    if try_free or only_free:
        try:
            return arm.first_line(start, goals, stage="retreat")
        except PlanningFailed:
            if only_free:
                raise
    return arm.first_line(start, goals, stage="retreat", check_collisions=False)


def back_out(arm: Arm) -> None:
    """Open the gripper and leave, after a failed attempt that stays in the record.

    Above an open surface the arm rises, through what it touches. Where it reached in level, as into a shelf or for a
    handle, it steps straight back on a way that is free of all but the target.
    """
    arm.hold_nothing()
    arm.open_gripper()
    with arm.planning():
        tcp = arm.planner.tcp(arm.at)
        arm.planner.set_scene(arm.scene.obstacles())
        if arm.env.task_config.target.approach == "top" and tcp[2, 2] < POINTS_DOWN:
            motion = arm.plan_rise(arm.scene.tcp_in_base, BACK_OUT_RISE, stage="recover")
        else:
            motion = plan_back_out(arm, [moved_back(tcp, distance) for distance in BACK_OUT])
    arm.follow(motion)


def plan_back_out(arm: Arm, goals: list[Array]) -> Trajectory:
    """Plan a straight line, free of all but the target, to the first of several TCP poses that one leads to."""
    try:
        return plan_step_back(arm, arm.at, goals, only_free=True)
    except PlanningFailed:
        arm.planner.set_scene(arm.scene.obstacles(without=int(arm.env.target_slot[0])))
        return plan_step_back(arm, arm.at, goals, only_free=True)
