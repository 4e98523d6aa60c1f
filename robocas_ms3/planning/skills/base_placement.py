"""Choose base poses to grasp an object, to pull a handle and to release an object above the basket.

The base drives only in configurations with ``base_motion: true``.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from robocas_ms3.core.errors import PlanningError
from robocas_ms3.core.poses import inverse, transform_points
from robocas_ms3.planning.protocol import Array, Obstacle
from robocas_ms3.planning.scene import to_arm_base_frame
from robocas_ms3.planning.skills.arm import Arm, plan_first_feasible, shift_back
from robocas_ms3.planning.skills.drive import (
    THINNED,
    Surroundings,
    arm_base_in_world,
    current_base_pose,
    drive,
    find_best_route,
    find_free_route,
    is_base_clear,
    read_surroundings,
    sample_base_poses,
)
from robocas_ms3.planning.skills.grasp import grasp
from robocas_ms3.planning.skills.handles import MovingPart, estimate_pull_fraction, open_furniture_part
from robocas_ms3.planning.skills.place import (
    attach_held_object,
    carry_and_release,
    sample_drop_poses,
)
from robocas_ms3.scenes.grasp_checks import (
    HALF_TURN,
    NEIGHBOURHOOD,
    PREGRASP_DISTANCE,
    grasp_direction_tests,
    is_gripper_clear,
)

GRASP_KINDS = 4  # kinds of grasps that consecutive attempts use
MAX_BASE_POSES = 3  # base poses tried for one skill
GRASPS_SAMPLED = 10  # grasps from which the reachable fraction is estimated
GRASPS_THOROUGH = 40  # the same, if no base pose reaches enough of those
GRASPS_TESTED = 250  # grasps whose gripper is tested for collisions
SIDE = "from_the_robots_side"
# minimum reachable fractions: of the grasps of an object, of a pull, of drop poses
MIN_GRASP_FRACTION, MIN_PULL_FRACTION, MIN_DROP_FRACTION = 0.3, 1.0, 0.1


def drive_and_grasp(arm: Arm, slot: int) -> None:
    """Drive to a base pose from which an object can be grasped, and grasp it.

    If no grasp can be planned, the robot drives to another base pose, up to ``MAX_BASE_POSES`` times.
    """
    first = arm.decision_path[-1] % GRASP_KINDS  # skip the kinds of earlier attempts
    kinds = [first, *(kind for kind in range(GRASP_KINDS) if kind != first)]
    _try_base_poses(
        arm,
        lambda relocate: drive_to_object(arm, slot, relocate=relocate),
        lambda: arm.run_first_candidate("grasp", *(partial(grasp, arm, slot, skip_kinds=one) for one in kinds)),
    )


def drive_and_open(arm: Arm) -> None:
    """Drive to a base pose that allows a whole pull of the handle, and open the door or drawer."""
    _try_base_poses(arm, lambda relocate: drive_to_handle(arm, relocate=relocate), lambda: open_furniture_part(arm))


def _try_base_poses(arm: Arm, drive_to: Callable[[bool], None], act: Callable[[], None]) -> None:
    """Drive to a base pose and act there.

    If ``act`` fails before it moves anything, both steps are repeated with another base pose.

    Args:
        arm: context of the attempt.
        drive_to: function that drives the base; its argument says whether another base pose is required.
        act: function that grasps or pulls; it raises PlanningError if it fails.
    """
    for number in range(MAX_BASE_POSES):
        drive_to(number > 0)
        length = len(arm.executor.actions)
        try:
            act()
            return
        except PlanningError:
            if len(arm.executor.actions) > length or not arm.executor.drives_base or number == MAX_BASE_POSES - 1:
                raise


def drive_to_object(arm: Arm, slot: int, *, relocate: bool = False) -> None:
    """Drive with a folded arm to a base pose from which an object can be grasped.

    The robot stays where it is if the object is within reach, unless ``relocate`` is set.
    """
    if not arm.executor.drives_base:
        return
    with arm.planning_time():
        others, grasps = arm.scene.obstacles_in_world(exclude=slot), find_clear_grasps(arm, slot)
        if (
            not relocate
            and estimate_reachable_fraction(arm, current_base_pose(arm), grasps, others) >= MIN_GRASP_FRACTION
        ):
            return
    around = _fold_arm(arm)
    with arm.planning_time():
        center = (arm.scene.arm_base_in_world @ arm.scene.object_in_base(slot))[:3, 3]
        goals = sample_base_poses(arm, center)
        seen = np.array([len(_select_near_side(arm, arm_base_in_world(arm, goal), grasps)) for goal in goals])
        goals = goals[seen >= max(1, 0.3 * seen.max(initial=0))]

        def route_to(mode: tuple[bool, float]) -> list[Array]:
            thorough, enough = mode

            def fraction(goal: Array) -> float:
                return estimate_reachable_fraction(arm, goal, grasps, others, thorough=thorough)

            return find_best_route(arm, goals, around, fraction, enough=enough)

        # if the nearest configurations collide, evaluate all configurations
        modes = (False, 2 * MIN_GRASP_FRACTION), (True, MIN_GRASP_FRACTION)
        route = plan_first_feasible(modes, route_to, PlanningError("drive", "no_base_pose"))
    drive(arm, *route)


def drive_to_handle(arm: Arm, *, relocate: bool = False) -> None:
    """Drive with a folded arm to a base pose from which the handle can be pulled.

    The robot stays where it is if the pull is possible there, unless ``relocate`` is set.
    """
    if not arm.executor.drives_base:
        return
    part = MovingPart.from_task(arm)

    def fraction(goal: Array) -> float:
        frame = arm_base_in_world(arm, goal)
        if not is_base_clear(arm.robot, frame, swept):  # the opening part would hit the robot
            return 0.0
        return estimate_pull_fraction(arm, part, frame, to_arm_base_frame(others, frame))

    with arm.planning_time():
        others = arm.scene.obstacles_in_world(exclude_link=(part.furniture, part.handle.link))
        moved = part.poses_in_world(arm, part.pull_positions(arm))
        swept = np.concatenate(
            [transform_points(frame, part.surface_points(arm)[::THINNED]) for frame in moved[::THINNED]]
        )
        if not relocate and fraction(current_base_pose(arm)) >= MIN_PULL_FRACTION:
            return
    around = _fold_arm(arm)
    with arm.planning_time():
        center = (moved @ part.grasp_in_part)[:, :3, 3].mean(axis=0)
        route = find_best_route(arm, sample_base_poses(arm, center), around, fraction, enough=MIN_PULL_FRACTION)
    drive(arm, *route)


def place_in_basket(arm: Arm, slot: int) -> None:
    """Carry a held object to the basket, with a drive if necessary, and release it there."""
    arm.start_subgoal("transfer object")
    drive_to_basket(arm, slot)
    arm.run_first_candidate("release", lambda: carry_and_release(arm, slot))


def drive_to_basket(arm: Arm, slot: int) -> None:
    """Drive with a held object to a base pose from which the arm reaches the basket.

    The robot prefers the base pose at the start of the episode, then the present base pose, then the best of sampled
    base poses.
    """
    if not arm.executor.drives_base:
        return

    def fraction(goal: Array) -> float:
        poses = sample_drop_poses(arm, slot, arm_base_in_world(arm, goal))
        return float(arm.inverse_kinematics.nearest_solutions(poses, arm.qpos)[0].mean())

    with arm.planning_time():
        attach_held_object(arm, slot)
        around = read_surroundings(arm, exclude=slot)
        start, here = np.zeros(3), current_base_pose(arm)
        route = None
        if np.any(here) and fraction(start) >= MIN_DROP_FRACTION:
            route = find_free_route(arm, here, start, around, back_first=True)
        if route is None and fraction(here) >= MIN_DROP_FRACTION:
            return
        if route is None:
            basket = arm.env.fixtures.basket
            assert basket is not None  # required by the task
            center = basket.pose.p[0].cpu().numpy()
            route = find_best_route(arm, sample_base_poses(arm, center), around, fraction, enough=MIN_DROP_FRACTION)
    drive(arm, *route)
    if not arm.is_holding(slot):
        raise PlanningError("drive", "dropped")


def _fold_arm(arm: Arm) -> Surroundings:
    with arm.planning_time():
        arm.planner.set_scene(arm.scene.obstacles())
        home = arm.plan_home(arm.qpos)
        around = read_surroundings(arm)
    arm.follow(home)
    return around


def find_clear_grasps(arm: Arm, slot: int) -> Array:
    """Return annotated grasps (G, 4, 4) of an object whose gripper approaches without contact.

    Grasps are TCP poses in the world frame.

    The robot's base pose is not taken into account.
    """
    base, object_in_base = arm.scene.arm_base_in_world, arm.scene.object_in_base(slot)
    object_in_world = base @ object_in_base
    notes = arm.env.object_assets[0][slot].annotations
    poses = object_in_world @ notes.grasps_tcp_in_object[:: max(1, len(notes.grasp_widths) // GRASPS_TESTED)]
    tests = grasp_direction_tests(poses, np.ones(3), arm.approach)
    poses = poses[np.all([passed for name, passed in tests.items() if name != SIDE], axis=0)]
    near = arm.scene.points_in_base(exclude=slot, radius=NEIGHBOURHOOD, around=object_in_base[:3, 3])
    return poses[is_gripper_clear(poses, transform_points(base, near))]


def estimate_reachable_fraction(
    arm: Arm, base: Array, grasps: Array, others: list[Obstacle], *, thorough: bool = False
) -> float:
    """Estimate the fraction of grasps that the arm reaches from a base pose.

    A grasp counts if the arm reaches its pre-grasp pose too.

    Args:
        arm: context of the attempt.
        base: (3,) base pose: x m, y m, yaw rad.
        grasps: (G, 4, 4) TCP poses of `find_clear_grasps`; grasps from the side opposite to the robot are ignored.
        others: all other bodies, with poses in the world frame.
        thorough: whether to evaluate more grasps, and all configurations instead of the nearest; much slower.
    """
    frame = arm_base_in_world(arm, base)
    poses = _sample_grasp_poses(arm, frame, grasps, GRASPS_THOROUGH if thorough else GRASPS_SAMPLED)
    if not len(poses):
        return 0.0
    if thorough:
        qpos, of_pose = arm.inverse_kinematics.all_solutions(poses, arm.qpos)
    else:
        solved, nearest = arm.inverse_kinematics.nearest_solutions(poses, arm.qpos)
        qpos, of_pose = nearest[solved], np.flatnonzero(solved)
    arm.planner.set_scene(to_arm_base_frame(others, frame))
    possible = np.bincount(of_pose[arm.planner.is_free(qpos)], minlength=len(poses)) > 0
    at_grasp, at_pregrasp = possible.reshape(2, 2, -1)  # axes: grasp or pre-grasp; annotated or half turn; grasp
    return float((at_grasp & at_pregrasp).any(axis=0).mean())


def _sample_grasp_poses(arm: Arm, frame: Array, grasps: Array, count: int) -> Array:
    """Return TCP poses (4K, 4, 4) of K grasps, their half turns, and the pre-grasps of both.

    Poses are in the arm's base frame.

    The K <= ``count`` grasps are evenly spaced in ``grasps``.
    """
    chosen = _select_near_side(arm, frame, grasps)
    chosen = chosen[np.linspace(0, len(chosen) - 1, min(count, len(chosen))).round().astype(int)]
    poses = inverse(frame) @ np.concatenate([chosen, chosen @ HALF_TURN])
    return np.concatenate([poses, shift_back(poses, PREGRASP_DISTANCE)])


def _select_near_side(arm: Arm, frame: Array, grasps: Array) -> Array:
    center = grasps[:, :3, 3].mean(axis=0) if len(grasps) else np.zeros(3)
    return grasps[grasp_direction_tests(grasps, center - frame[:3, 3], arm.approach)[SIDE]]
