"""Complete a task from the physical state in which a learned policy left it (`evaluation.policy_rollin`).

The scripted policy brakes, opens the gripper unless it holds the target, retreats from objects in its way, and does the
task from there. Only this part is recorded.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from robocas_ms3.core.errors import PlanningError
from robocas_ms3.planning.executor import OPEN
from robocas_ms3.planning.protocol import Array, Trajectory
from robocas_ms3.planning.skills.arm import BACK_OUT, Arm, moved_back, plan_back_out, raised
from robocas_ms3.planning.skills.base_placement import bring_to_basket
from robocas_ms3.planning.skills.remove import hang_clear

BRAKE_SECONDS = 0.2  # held where it was taken over, until it stands; a step of a dataset at 5 Hz
LIFT = 0.10  # m that a held target is raised before it is carried, as after a grasp (`skills.grasping`)


def complete(arm: Arm, policy: Callable[[Arm], None]) -> None:
    """Do the task (``policy``) from a state in which another policy was; returns when it has succeeded.

    A held target is carried on; on every other attempt it is let go, since it may be held in a way that leads nowhere.
    """
    slot = arm.target
    arm.executor.move_gripper(arm.executor.gripper, arm.at, seconds=BRAKE_SECONDS)
    if arm.executor.gripper != OPEN and arm.holds(slot) and arm.path[0] % 2 == 0:
        _carry_on(arm, slot)
        return
    _get_free(arm)
    policy(arm)


def _carry_on(arm: Arm, slot: int) -> None:
    if not arm.executor.flag("target_lifted"):
        arm.begin_subgoal("move and grasp")
        with arm.planning():
            lift = arm.plan_rise(arm.planner.tcp(arm.at), LIFT, stage="lift")
        arm.follow(lift)
    if arm.approach == "top":
        hang_clear(arm, slot)  # it may have been lifted just above its neighbours
    if not arm.holds(slot):
        raise PlanningError("lift", "slipped")
    bring_to_basket(arm, slot)


def _get_free(arm: Arm) -> None:
    """Open the gripper, and leave what the arm touches: upwards, or back where something may be above."""
    if arm.executor.gripper != OPEN:
        arm.open_gripper()
    if arm.approach == "top":
        arm.rise_clear()
        return
    with arm.planning():
        arm.planner.set_scene(arm.scene.obstacles())
        if not arm.planner.collisions(arm.at, arm.planner.finger_width):
            return
        tcp = arm.planner.tcp(arm.at)
        try:
            motion = plan_back_out(arm, [moved_back(tcp, distance) for distance in BACK_OUT])
        except PlanningError:
            motion = _plan_off(arm, tcp)
    arm.follow(motion)


def _plan_off(arm: Arm, tcp_in_base: Array) -> Trajectory:
    """Plan the shortest straight line off what is touched, through it: back, up, or towards the robot."""
    arm.planner.set_scene(arm.scene.obstacles())
    for distance in BACK_OUT[::-1]:
        inward = tcp_in_base.copy()
        inward[:2, 3] *= 1 - distance / np.linalg.norm(tcp_in_base[:2, 3])
        for goal in (moved_back(tcp_in_base, distance), raised(tcp_in_base, distance), inward):
            try:
                line = arm.planner.plan_straight(arm.at, goal, stage="takeover", check_collisions=False)
            except PlanningError:
                continue
            if arm.planner.free(line.qpos[-1:], arm.planner.finger_width).all():
                return line
    raise PlanningError("takeover", "stuck")
