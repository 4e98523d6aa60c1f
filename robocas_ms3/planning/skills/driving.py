"""Drive the mobile base, the arm held still, to where a goal is within comfortable reach.

Base poses are joint positions (3,): x m, y m, yaw rad, in the frame of the robot's root, which stands on the floor.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from robocas_ms3.errors import PlanningFailed
from robocas_ms3.planning.protocol import Array
from robocas_ms3.planning.scene import inverse, matrix
from robocas_ms3.planning.skills.arm import Arm
from robocas_ms3.planning.timing import stopping
from robocas_ms3.robots.constants import ARM_BASE_ABOVE_BASE_LINK, BASE_LIMITS, BASE_LINK_HEIGHT
from robocas_ms3.scenes.grasping import PREGRASP_DISTANCE, directions_ok, gripper_is_clear
from robocas_ms3.scenes.placement import planar_pose, transform

SPEED, ACCELERATION = 0.25, 0.4  # m/s and rad/s; m/s^2 and rad/s^2
SETTLE_SECONDS = 0.4
ARRIVED = 0.01  # m, rad
CHECK_STEP = 0.08  # m or rad between poses at which a drive is checked
LIMIT_MARGIN = 0.01
# What stands on the floor: half sizes in x and y and the height up to which it goes, m, with room to spare
BODY_BOXES = ((0.28, 0.23, 0.30), (0.15, 0.13, 0.49))
SAMPLES, TRIED = 400, 14  # base poses drawn; those of them for which inverse kinematics is solved
GRASPS = 10  # grasps that stand for all when reach is judged
GRASPS_LOOKED_AT = 250
SIDE = "from_the_robots_side"
COMFORTABLE = 0.3  # share of them that has to be within reach
ARM_LENGTH = 1.2  # m from its base to the tips, hand and what it holds included
THINNED = 3  # every third point of the clouds will do: nothing thinner than 2 cm could slip between them
DISTANCES = (0.45, 0.80)  # m from the arm's base to what it reaches for, level
BEST_DISTANCE = 0.58
DETOURS = (0.15, 0.30)  # m straight back first


def base_at(arm: Arm) -> Array:
    """(3,) where the base was last told to be."""
    return np.array(arm.executor.base, dtype=float)


def arm_base_in_world(arm: Arm, base: Array) -> Array:
    """4x4 of the arm's base with the base joints at a pose."""
    root = matrix(arm.env.agent.robot.pose.raw_pose[0])
    height = BASE_LINK_HEIGHT + ARM_BASE_ABOVE_BASE_LINK
    return root @ planar_pose(float(base[0]), float(base[1]), height, float(base[2]))


def drive(arm: Arm, *goals: Array) -> None:
    """Drive straight to one base pose after the other and let the base settle.

    Raises:
        PlanningFailed: something held it up.
    """
    for goal in goals:
        if np.abs(goal - base_at(arm)).max() < 1e-6:
            continue
        motion = stopping(np.array([base_at(arm), goal]), velocity=SPEED, acceleration=ACCELERATION, dt=arm.executor.dt)
        wait = np.repeat(goal[None], max(1, round(SETTLE_SECONDS / arm.executor.dt)), axis=0)
        arm.executor.drive(np.concatenate([motion.qpos, wait]), arm.at)
        now = arm.env.agent.robot.get_qpos()[0, :3].cpu().numpy()
        if np.abs(now - goal).max() > ARRIVED:
            raise PlanningFailed("drive", "held_up")


def drive_to_reach(arm: Arm, slot: int, *, elsewhere: bool = False) -> None:
    """Fold the arm and drive to where an object is within comfortable reach, unless it is already.

    Args:
        arm: the attempt's tools.
        slot: of the object.
        elsewhere: drive even so, since no grasp could be planned from here.

    Raises:
        PlanningFailed: there is no such place, or no straight way there.
    """
    if not arm.executor.drives:
        return
    with arm.planning():
        in_base = arm.scene.obstacles_in_base()
        cloud = transform(arm.scene.arm_base_in_world, in_base)
        others = transform(arm.scene.arm_base_in_world, arm.scene.obstacles_in_base(without=slot))
        grasps = clear_grasps(arm, slot, others)
        if not elsewhere and reach_share(arm, base_at(arm), grasps, others) >= COMFORTABLE:
            return
        arm.planner.set_scene(in_base)
        home = arm.plan_home(arm.at)
    arm.follow(home)
    with arm.planning():
        route = _best_route(arm, slot, grasps, cloud, others)
    drive(arm, *route)


def drive_back(arm: Arm) -> None:
    """Drive back to where the episode began, if there is a free way.

    Raises:
        PlanningFailed: no free way, or something held it up.
    """
    if not arm.executor.drives or not np.any(base_at(arm)):
        return
    with arm.planning():
        held = np.flatnonzero(arm.env.grasped()[0].cpu().numpy())
        cloud = arm.scene.obstacles_in_base(without=int(held[0]) if len(held) else None)
        cloud = transform(arm.scene.arm_base_in_world, cloud)
        route = free_route(arm, base_at(arm), np.zeros(3), cloud, leaving=True)
    if route is None:
        raise PlanningFailed("drive", "blocked")
    drive(arm, *route)


def clear_grasps(arm: Arm, slot: int, others: Array) -> Array:
    """An object's grasps (G, 4, 4) in the world, whichever side they come from, whose way in is clear.

    Args:
        arm: the attempt's tools.
        slot: of the object.
        others: (P, 3) surfaces of everything else, world, m.
    """
    object_in_world = arm.scene.arm_base_in_world @ arm.scene.object_in_base(slot)
    notes = arm.env.object_assets[0][slot].annotations
    poses = object_in_world @ notes.grasps_tcp_in_object[:: max(1, len(notes.grasp_widths) // GRASPS_LOOKED_AT)]
    tests = directions_ok(poses, np.ones(3), arm.env.task_config.target.approach)
    poses = poses[np.all([passed for name, passed in tests.items() if name != SIDE], axis=0)]
    near = others[np.linalg.norm(others - object_in_world[:3, 3], axis=1) < 0.5]
    return poses[gripper_is_clear(poses, near)]


def reach_share(arm: Arm, base: Array, grasps: Array, others: Array) -> float:
    """Share of grasps that the arm reaches from a base pose without touching anything, pre-grasps included.

    Args:
        arm: the attempt's tools.
        base: (3,).
        grasps: (G, 4, 4) from ``clear_grasps``; those that come from the far side count as out of reach.
        others: (P, 3) surfaces of everything but the object, world, m.
    """
    frame = arm_base_in_world(arm, base)
    chosen = _from_here(arm, frame, grasps)
    if not len(chosen):
        return 0.0
    chosen = chosen[np.linspace(0, len(chosen) - 1, min(GRASPS, len(chosen))).round().astype(int)]
    poses = inverse(frame) @ np.concatenate([chosen, chosen @ np.diag([-1.0, -1, 1, 1])])  # and their twins
    before = poses.copy()
    before[:, :3, 3] -= PREGRASP_DISTANCE * before[:, :3, 2]
    solved, qpos = arm.reachability.reachable(np.concatenate([poses, before]), arm.at)
    local = transform(inverse(frame), others[::THINNED])
    arm.planner.set_scene(local[np.linalg.norm(local, axis=1) < ARM_LENGTH])
    free = [bool(ok) and not arm.planner.collisions(q) for ok, q in zip(solved, qpos, strict=True)]
    held, entered = np.array(free).reshape(2, 2, -1)  # grasp or pre-grasp; as annotated or its twin; which
    return float((held & entered).any(axis=0).mean())


def _from_here(arm: Arm, frame: Array, grasps: Array) -> Array:
    """Those of the grasps (G, 4, 4) that come from where the arm's base (4x4, world) stands."""
    center = grasps[:, :3, 3].mean(axis=0) if len(grasps) else np.zeros(3)
    return grasps[directions_ok(grasps, center - frame[:3, 3], arm.env.task_config.target.approach)[SIDE]]


def _best_route(arm: Arm, slot: int, grasps: Array, cloud: Array, others: Array) -> list[Array]:
    low, high = np.array(BASE_LIMITS).T + np.array([[LIMIT_MARGIN], [-LIMIT_MARGIN]])
    high[2], low[2] = 0.6, -0.6
    center = (arm.scene.arm_base_in_world @ arm.scene.object_in_base(slot))[:3, 3]
    goals = arm.rng.uniform(low, high, (SAMPLES, 3))
    start = base_at(arm)
    frames = np.array([arm_base_in_world(arm, goal) for goal in goals])
    distance = np.linalg.norm((frames[:, :2, 3] - center[:2]), axis=1)
    ahead = np.einsum("ni,ni->n", frames[:, :2, 0], center[:2] - frames[:, :2, 3]) / distance
    possible = (distance > DISTANCES[0]) & (distance < DISTANCES[1]) & (ahead > 0.7)
    order = np.argsort(np.abs(distance - BEST_DISTANCE) + 0.2 * np.linalg.norm(goals - start, axis=1))
    enough = (
        max(1, 0.3 * max(len(_from_here(arm, frame, grasps)) for frame in frames[possible])) if any(possible) else 1
    )
    best: tuple[float, list[Array]] = (0.0, [])
    tried = 0
    for i in order:
        if not possible[i] or len(_from_here(arm, frames[i], grasps)) < enough or not body_is_free(frames[i], cloud):
            continue
        tried += 1
        if tried > TRIED:
            break
        share = reach_share(arm, goals[i], grasps, others)
        if share > best[0] and (route := free_route(arm, start, goals[i], cloud, leaving=False)):
            best = share, route
            if share >= 2 * COMFORTABLE:
                break
    if not best[1]:
        raise PlanningFailed("drive", "nowhere_to_go")
    return best[1]


def free_route(arm: Arm, start: Array, goal: Array, cloud: Array, *, leaving: bool) -> list[Array] | None:
    """Base poses to drive to one after the other: straight, or by way of a place behind the narrower end.

    Args:
        arm: the attempt's tools; the arm stays as it stands.
        start: (3,).
        goal: (3,).
        cloud: (P, 3) surfaces of all obstacles, world, m.
        leaving: whether ``start`` is the narrower end, so that the robot backs out first; else it moves up last.
    """
    for route in _routes(start, goal, leaving):
        poses = [start, *route]
        if all(_leg_is_free(arm, a, b, cloud) for a, b in zip(poses[:-1], poses[1:], strict=True)):
            return route
    return None


def _routes(start: Array, goal: Array, leaving: bool) -> Iterator[list[Array]]:
    yield [goal]
    narrow = start if leaving else goal
    for distance in DETOURS:
        via = narrow - distance * np.array([np.cos(narrow[2]), np.sin(narrow[2]), 0])
        if all(a <= v <= b for v, (a, b) in zip(via, BASE_LIMITS, strict=True)):
            yield [via, goal]


def _leg_is_free(arm: Arm, start: Array, goal: Array, cloud: Array) -> bool:
    count = max(2, int(np.ceil(np.abs(goal - start).max() / CHECK_STEP)) + 1)
    cloud = cloud[::THINNED]
    width = arm.planner.finger_width
    for pose in np.linspace(start, goal, count)[1:]:
        frame = arm_base_in_world(arm, pose)
        if not body_is_free(frame, cloud):
            return False
        local = transform(inverse(frame), cloud)
        arm.planner.set_scene(local[np.linalg.norm(local, axis=1) < ARM_LENGTH])
        if arm.planner.collisions(arm.at, width):
            return False
    return True


def body_is_free(arm_base_in_world: Array, cloud: Array) -> bool:
    """Whether none of the points (P, 3), world, is where the body on the floor would be."""
    local = transform(inverse(arm_base_in_world), cloud)
    local[:, 2] += BASE_LINK_HEIGHT + ARM_BASE_ABOVE_BASE_LINK  # above the floor
    inside = [np.all(np.abs(local[:, :2]) <= (x, y), axis=1) & (local[:, 2] <= z) for x, y, z in BODY_BOXES]
    return not np.logical_or.reduce(inside).any()
