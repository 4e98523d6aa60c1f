"""Expert interventions (DAgger): complete a task from the state in which a learned policy left it.

The scripted policy stops the arm, opens the gripper unless it holds the target, retreats from objects that it touches,
and does the task from there. Only this part is recorded. `evaluation.rollouts.policy_rollin` runs the learned policy.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from robocas_ms3.core.errors import PlanningError
from robocas_ms3.planning.executor import OPEN
from robocas_ms3.planning.protocol import Array, Trajectory
from robocas_ms3.planning.skills.arm import RETREAT_DISTANCES, Arm, plan_free_retreat, shift_back, shift_up
from robocas_ms3.planning.skills.base_placement import place_in_basket
from robocas_ms3.planning.skills.remove import raise_held_object

STOP_SECONDS = 0.2  # s to hold the initial position until the arm is at rest; a step of a dataset at 5 Hz
LIFT = 0.10  # m that a held target is lifted before it is carried, as after a grasp (`skills.grasp`)


def intervene(arm: Arm, policy: Callable[[Arm], None]) -> None:
    """Complete the task with a scripted policy from the state in which another policy left the scene.

    In attempts with an even number, a held target is carried to the basket. In attempts with an odd number, the target
    is released first, since the grasp may be unusable.

    Args:
        arm: context of the attempt.
        policy: scripted policy of the task.

    Raises:
        PlanningError: the attempt fails.
    """
    slot = arm.target
    arm.executor.move_gripper(arm.executor.gripper, arm.qpos, seconds=STOP_SECONDS)
    if arm.executor.gripper != OPEN and arm.is_holding(slot) and arm.decision_path[0] % 2 == 0:
        _carry_held_target(arm, slot)
        return
    _retreat(arm)
    policy(arm)


def _carry_held_target(arm: Arm, slot: int) -> None:
    if not arm.executor.is_flag_set("target_lifted"):
        arm.start_subgoal("move and grasp")
        with arm.planning_time():
            lift = arm.plan_rise(arm.planner.tcp(arm.qpos), LIFT, stage="lift")
        arm.follow(lift)
    if arm.approach == "top":
        raise_held_object(arm, slot)  # it may be only just above its neighbours
    if not arm.is_holding(slot):
        raise PlanningError("lift", "slipped")
    place_in_basket(arm, slot)


def _retreat(arm: Arm) -> None:
    """Open the gripper and move until the arm touches nothing.

    The arm moves up, or back after an approach from the front.
    """
    if arm.executor.gripper != OPEN:
        arm.open_gripper()
    if arm.approach == "top":
        arm.rise_until_free()
        return
    with arm.planning_time():
        arm.planner.set_scene(arm.scene.obstacles())
        if not arm.planner.find_collisions(arm.qpos, arm.planner.finger_width):
            return
        tcp = arm.planner.tcp(arm.qpos)
        try:
            motion = plan_free_retreat(arm, [shift_back(tcp, distance) for distance in RETREAT_DISTANCES])
        except PlanningError:
            motion = _plan_shortest_retreat(arm, tcp)
    arm.follow(motion)


def _plan_shortest_retreat(arm: Arm, tcp_in_base: Array) -> Trajectory:
    """Plan the shortest straight retreat that ends in a collision-free pose.

    The retreat leads back, up or towards the robot.

    The path itself may collide.
    """
    arm.planner.set_scene(arm.scene.obstacles())
    for distance in RETREAT_DISTANCES[::-1]:
        inward = tcp_in_base.copy()
        inward[:2, 3] *= 1 - distance / np.linalg.norm(tcp_in_base[:2, 3])
        for goal in (shift_back(tcp_in_base, distance), shift_up(tcp_in_base, distance), inward):
            try:
                line = arm.planner.plan_straight(arm.qpos, goal, stage="intervention", check_collisions=False)
            except PlanningError:
                continue
            if arm.planner.is_free(line.qpos[-1:], arm.planner.finger_width).all():
                return line
    raise PlanningError("intervention", "no_free_retreat")
