"""Where the mobile base stands: to reach an object, to pull at a handle, to let go above the basket.

The base drives only where the configuration lets policies drive.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from robocas_ms3.core.errors import PlanningError
from robocas_ms3.core.poses import inverse, transform_points
from robocas_ms3.planning.protocol import Array, Obstacle
from robocas_ms3.planning.scene import seen_from
from robocas_ms3.planning.skills.arm import Arm, first_plan, moved_back
from robocas_ms3.planning.skills.drive import (
    THINNED,
    Surroundings,
    arm_base_in_world,
    base_at,
    best_route,
    drive,
    free_route,
    is_body_clear,
    places_before,
    surroundings,
)
from robocas_ms3.planning.skills.grasp import grasp
from robocas_ms3.planning.skills.handles import Part, open_part, pull_share
from robocas_ms3.planning.skills.place import attach_held, carry_to_basket, drop_poses, release_into_basket
from robocas_ms3.scenes.grasp_checks import (
    HALF_TURN,
    NEIGHBOURHOOD,
    PREGRASP_DISTANCE,
    check_directions,
    is_gripper_clear,
)

KINDS = 4  # of grasps that attempts take one after the other
PLACES = 3  # to do one thing from
GRASPS = 10  # grasps that stand for all when reach is judged
GRASPS_THOROUGH = 40  # the same where none of those can be reached from anywhere
GRASPS_LOOKED_AT = 250
SIDE = "from_the_robots_side"
# shares that are comfortable: of an object's grasps, of the way of a pull, of poses above the basket
COMFORTABLE, PULLED, ABOVE_BASKET = 0.3, 1.0, 0.1


def grasp_from_reach(arm: Arm, slot: int) -> None:
    """Grasp an object from a place within comfortable reach, or from another place if no grasp can be planned there."""
    kind = arm.path[-1] % KINDS  # not again what has failed before
    _from_some_place(
        arm,
        lambda elsewhere: drive_to_object(arm, slot, elsewhere=elsewhere),
        lambda: grasp(arm, slot, other_than=kind),
    )


def open_from_reach(arm: Arm) -> None:
    """Open what the task wants opened, from where its handle is within comfortable reach all the way."""
    _from_some_place(arm, lambda elsewhere: drive_to_handle(arm, elsewhere=elsewhere), lambda: open_part(arm))


def _from_some_place(arm: Arm, go: Callable[[bool], None], act: Callable[[], None]) -> None:
    """Go and act; where acting fails before anything moves, go elsewhere and act again."""
    for place in range(PLACES):
        go(place > 0)
        length = len(arm.executor.actions)
        try:
            act()
            return
        except PlanningError:
            if len(arm.executor.actions) > length or not arm.executor.drives or place == PLACES - 1:
                raise


def drive_to_object(arm: Arm, slot: int, *, elsewhere: bool = False) -> None:
    """Fold the arm and drive within comfortable reach of an object; if already there, only with ``elsewhere``."""
    if not arm.executor.drives:
        return
    with arm.planning():
        others, grasps = arm.scene.obstacles_in_world(without=slot), clear_grasps(arm, slot)
        if not elsewhere and reach_share(arm, base_at(arm), grasps, others) >= COMFORTABLE:
            return
    around = _fold(arm)
    with arm.planning():
        center = (arm.scene.arm_base_in_world @ arm.scene.object_in_base(slot))[:3, 3]
        goals = places_before(arm, center)
        seen = np.array([len(_from_here(arm, arm_base_in_world(arm, goal), grasps)) for goal in goals])
        goals = goals[seen >= max(1, 0.3 * seen.max(initial=0))]

        def route_to(judged: tuple[bool, float]) -> list[Array]:
            thorough, enough = judged

            def share(goal: Array) -> float:
                return reach_share(arm, goal, grasps, others, thorough=thorough)

            return best_route(arm, goals, around, share, enough=enough)

        # where the elbow is in the way of the nearest configurations, others are judged too
        route = first_plan(((False, 2 * COMFORTABLE), (True, COMFORTABLE)), route_to, PlanningError("drive", "nowhere"))
    drive(arm, *route)


def drive_to_handle(arm: Arm, *, elsewhere: bool = False) -> None:
    """Fold the arm and drive to where it can pull the handle far enough; if it can already, only with ``elsewhere``."""
    if not arm.executor.drives:
        return
    part = Part.of(arm)

    def share(goal: Array) -> float:
        frame = arm_base_in_world(arm, goal)
        if not is_body_clear(arm.robot, frame, swept):  # what opens would run into it
            return 0.0
        return pull_share(arm, part, frame, seen_from(others, frame))

    with arm.planning():
        others = arm.scene.obstacles_in_world(without_link=(part.furniture, part.handle.link))
        moved = part.in_world(arm, part.way(arm))
        swept = np.concatenate([transform_points(frame, part.surface(arm)[::THINNED]) for frame in moved[::THINNED]])
        if not elsewhere and share(base_at(arm)) >= PULLED:
            return
    around = _fold(arm)
    with arm.planning():
        center = (moved @ part.hold)[:, :3, 3].mean(axis=0)
        route = best_route(arm, places_before(arm, center), around, share, enough=PULLED)
    drive(arm, *route)


def bring_to_basket(arm: Arm, slot: int) -> None:
    arm.begin_subgoal("transfer object")
    drive_to_basket(arm, slot)
    carry_to_basket(arm, slot)
    release_into_basket(arm, slot)


def drive_to_basket(arm: Arm, slot: int) -> None:
    """Drive back to the start of the episode, an object in the gripper.

    Where there is no free way, or the basket is out of reach from there, stay if it is in reach, else drive to where it
    is.
    """
    if not arm.executor.drives:
        return

    def share(goal: Array) -> float:
        poses = drop_poses(arm, slot, arm_base_in_world(arm, goal))
        return float(arm.reachability.reachable(poses, arm.at)[0].mean())

    with arm.planning():
        attach_held(arm, slot)
        around = surroundings(arm, without=slot)
        start, here = np.zeros(3), base_at(arm)
        route = None
        if np.any(here) and share(start) >= ABOVE_BASKET:
            route = free_route(arm, here, start, around, leaving=True)
        if route is None and share(here) >= ABOVE_BASKET:
            return
        if route is None:
            basket = arm.env.fixtures.basket
            assert basket is not None  # the task has one
            center = basket.pose.p[0].cpu().numpy()
            route = best_route(arm, places_before(arm, center), around, share, enough=ABOVE_BASKET)
    drive(arm, *route)
    if not arm.holds(slot):
        raise PlanningError("drive", "dropped")


def _fold(arm: Arm) -> Surroundings:
    with arm.planning():
        arm.planner.set_scene(arm.scene.obstacles())
        home = arm.plan_home(arm.at)
        around = surroundings(arm)
    arm.follow(home)
    return around


def clear_grasps(arm: Arm, slot: int) -> Array:
    """Return an object's grasps (G, 4, 4) in the world with a clear way in, from any side."""
    base, object_in_base = arm.scene.arm_base_in_world, arm.scene.object_in_base(slot)
    object_in_world = base @ object_in_base
    notes = arm.env.object_assets[0][slot].annotations
    poses = object_in_world @ notes.grasps_tcp_in_object[:: max(1, len(notes.grasp_widths) // GRASPS_LOOKED_AT)]
    tests = check_directions(poses, np.ones(3), arm.approach)
    poses = poses[np.all([passed for name, passed in tests.items() if name != SIDE], axis=0)]
    near = arm.scene.obstacles_in_base(without=slot, radius=NEIGHBOURHOOD, around=object_in_base[:3, 3])
    return poses[is_gripper_clear(poses, transform_points(base, near))]


def reach_share(arm: Arm, base: Array, grasps: Array, others: list[Obstacle], *, thorough: bool = False) -> float:
    """Return the share of grasps (with pre-grasps) that the arm reaches from a base pose (3,) without collisions.

    Args:
        grasps: (G, 4, 4) from ``clear_grasps``; those that come from the far side count as out of reach.
        others: everything but the object, in the world.
        thorough: judge more grasps, by all configurations instead of the nearest; far slower.
    """
    frame = arm_base_in_world(arm, base)
    poses = _poses_of_some(arm, frame, grasps, GRASPS_THOROUGH if thorough else GRASPS)
    if not len(poses):
        return 0.0
    if thorough:
        qpos, of_pose = arm.reachability.everything(poses, arm.at)
    else:
        solved, nearest = arm.reachability.reachable(poses, arm.at)
        qpos, of_pose = nearest[solved], np.flatnonzero(solved)
    arm.planner.set_scene(seen_from(others, frame))
    possible = np.bincount(of_pose[arm.planner.free(qpos)], minlength=len(poses)) > 0
    held, entered = possible.reshape(2, 2, -1)  # grasp or pre-grasp; as annotated or its twin; which
    return float((held & entered).any(axis=0).mean())


def _poses_of_some(arm: Arm, frame: Array, grasps: Array, count: int) -> Array:
    """Return poses (4K, 4, 4) in an arm's base frame: K <= count grasps and their twins, then their pre-grasps."""
    chosen = _from_here(arm, frame, grasps)
    chosen = chosen[np.linspace(0, len(chosen) - 1, min(count, len(chosen))).round().astype(int)]
    poses = inverse(frame) @ np.concatenate([chosen, chosen @ HALF_TURN])
    return np.concatenate([poses, moved_back(poses, PREGRASP_DISTANCE)])


def _from_here(arm: Arm, frame: Array, grasps: Array) -> Array:
    center = grasps[:, :3, 3].mean(axis=0) if len(grasps) else np.zeros(3)
    return grasps[check_directions(grasps, center - frame[:3, 3], arm.approach)[SIDE]]
