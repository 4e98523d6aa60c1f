"""Grasp an object with one of its annotated grasps and move it out of its surroundings.

After a grasp from above the arm lifts the object. After a grasp from the front it lifts the object slightly and
withdraws straight back, so that neighbouring objects stay upright.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import PlanningError
from robocas_ms3.core.poses import inverse
from robocas_ms3.planning.grasp_choice import compute_grip_margins, filter_grasps, sample_grasp_order, score_grasps
from robocas_ms3.planning.protocol import Array, AttachedBody, Trajectory
from robocas_ms3.planning.scene import SPACING
from robocas_ms3.planning.skills.arm import CLEARANCE, Arm, PlannedPrimitive, shift_back, shift_up
from robocas_ms3.scenes.grasp_checks import NEIGHBOURHOOD, PREGRASP_DISTANCE, is_gripper_clear, select_near_points

GRASPS_CHECKED = 48  # grasps that are ordered by a collision check of the arm
CLEARED_AT_ONCE = 12  # grasps per batch of gripper checks
MAX_PREGRASPS = 4  # pre-grasp configurations per grasp
MAX_PREGRASP_GOALS = 6  # pre-grasp configurations that are goals of one path search
GRASPS_COMPARED = 96  # grasps that are grouped into kinds
KIND_TOLERANCES = 0.02, np.deg2rad(30)  # m, rad between grasps of the same kind
GRASPS_PLANNED = 12  # maximum number of grasps to plan motions for
# m; the first height with a free exit path is used. The smallest one completes the lift stage (3 cm)
FRONT_LIFTS = (0.04, 0.08, 0.14, 0.2)
WITHDRAWALS = (0.25, 0.18, 0.12)  # m straight back; the first reachable one is used
# m against the approach axis; an annotated grasp of a flat object that lies on a surface may touch the surface
RETRACTIONS = (0.0, 0.004, 0.008)
NO_CANDIDATES = frozenset({"no_clear_grasp", "unreachable", "no_suitable_grasp"})
"""Reasons for which `grasp_candidates` finds no grasp of the best kind; they do not depend on random numbers."""

ExitMotions = tuple[Trajectory, ...]


def grasp(
    arm: Arm,
    slot: int,
    *,
    lift_height: float = 0.10,
    skip_kinds: int = 0,
    grasps: Iterable[Array] = (),
    movable: Collection[int] = (),
) -> None:
    """Grasp an object and move it out of its surroundings.

    After an approach from above the arm lifts the object. After an approach from the front it lifts the object slightly
    and withdraws straight back.

    Args:
        arm: context of the attempt.
        slot: slot of the object.
        lift_height: lift after a grasp from above, m (RoboCAS-v0: 0.10 for pick, 0.15 for search).
        skip_kinds: number of kinds of similar grasps to skip, from the best kind on.
        grasps: TCP poses (4x4) to try in this order, in the arm's base frame; empty: the annotated grasps.
        movable: slots of other objects that the gripper may touch and move.

    Raises:
        PlanningError: no grasp can be planned, the fingers miss the object, or the object slips out.
    """
    with arm.planning_time():
        grasps = grasps or grasp_candidates(arm, slot, skip_kinds, movable)
        approach, out = plan_grasp(arm, slot, lift_height, grasps, movable)
        arm.planned = PlannedPrimitive("grasp", slot, arm.planner.tcp(approach.qpos[-1]))
    arm.follow(approach)
    arm.close_gripper()
    if not arm.is_holding(slot):
        raise PlanningError("grasp", "missed")
    arm.follow(*out)
    if not arm.is_holding(slot):
        raise PlanningError("lift", "slipped")


def plan_grasp(
    arm: Arm, slot: int, lift_height: float, grasps: Iterable[Array], movable: Collection[int] = ()
) -> tuple[Trajectory, ExitMotions]:
    """Plan the approach to the first feasible grasp, and the exit with the object.

    The exit moves the object out of its surroundings.

    Args:
        arm: context of the attempt.
        slot: slot of the object.
        lift_height: lift after a grasp from above, m.
        grasps: TCP poses (4x4) in the arm's base frame, in this order.
        movable: slots of other objects that are no obstacles from the pre-grasp on.

    Returns:
        Motion to the grasp; motions with the grasped object.
    """
    planner, failure = arm.planner, PlanningError("grasp_sampling", "no_feasible_grasp")
    everything, others = arm.scene.obstacles(), arm.scene.obstacles(exclude={slot, *movable})
    with_room = arm.scene.obstacles(clearance=CLEARANCE)
    ways: list[tuple[Array, Trajectory, ExitMotions]] = []  # pre-grasp configuration, approach, exit

    def join_approach(reach: Trajectory, inward: Trajectory, out: ExitMotions) -> tuple[Trajectory, ExitMotions]:
        planner.set_scene(everything)
        return planner.join(arm.qpos, reach, inward), out

    def search_path() -> tuple[Trajectory, ExitMotions]:
        planner.set_scene(everything)
        reach = planner.plan_to_qpos(arm.qpos, [way[0] for way in ways], stage="reach")
        _, inward, out = min(ways, key=lambda way: float(np.abs(way[0] - reach.qpos[-1]).max()))
        return join_approach(reach, inward, out)

    for tcp_in_base in grasps:
        # the object is an obstacle on the way to the pre-grasp only
        planner.set_scene(others)
        starts = planner.ik(shift_back(tcp_in_base, PREGRASP_DISTANCE), arm.qpos)[:MAX_PREGRASPS]
        failure = failure if starts else PlanningError("approach", "no_ik")
        for start in starts:
            try:
                planner.set_scene(with_room)
                reach = planner.plan_to_qpos(arm.qpos, [start], stage="reach", straight_only=True)
            except PlanningError:
                reach = None
            try:
                planner.set_scene(others)
                inward, out = _plan_approach_and_exit(arm, slot, start, tcp_in_base, lift_height)
            except PlanningError as error:
                failure = error
                continue
            if reach is not None:
                return join_approach(reach, inward, out)
            ways.append((start, inward, out))
        # a path search costs as much as everything else and accepts several goals
        if len(ways) >= MAX_PREGRASP_GOALS:
            try:
                return search_path()
            except PlanningError as error:
                failure, ways = error, []
    if ways:
        return search_path()
    raise failure


def grasp_candidates(arm: Arm, slot: int, skip_kinds: int, movable: Collection[int] = ()) -> Iterator[Array]:
    """Yield TCP poses (4x4) of reachable grasps whose gripper touches nothing, the best first.

    The best ``skip_kinds`` kinds of similar grasps are omitted. If there is no such grasp, all grasps are shifted back
    by the next distance of `RETRACTIONS`. Each pose is in the arm's base frame. The gripper may touch the objects in
    the slots ``movable``.
    """
    notes = arm.env.object_assets[0][slot].annotations
    base, object_in_base = arm.scene.arm_base_in_world, arm.scene.object_in_base(slot)
    kept = filter_grasps(notes, base @ object_in_base, base, arm.approach)
    surface = arm.env.object_assets[0][slot].surface_points(SPACING)
    near = arm.scene.points_in_base(exclude={slot, *movable}, radius=NEIGHBOURHOOD, around=object_in_base[:3, 3])
    any_reachable = False
    for distance in RETRACTIONS:
        tcp_in_base = shift_back(inverse(base) @ kept.tcp_in_world, distance)
        solved, qpos = arm.inverse_kinematics.nearest_solutions(tcp_in_base, arm.qpos)
        solved_before, qpos_before = arm.inverse_kinematics.nearest_solutions(
            shift_back(tcp_in_base, PREGRASP_DISTANCE), arm.qpos
        )
        reachable = np.flatnonzero(solved & solved_before)
        if not len(reachable):
            continue
        any_reachable = True
        scores = score_grasps(
            tcp_in_base[reachable],
            kept.qualities[reachable],
            compute_grip_margins(notes.grasps_tcp_in_object[kept.index[reachable]], kept.widths[reachable], surface),
            np.abs(qpos[reachable] - arm.qpos).max(axis=1),
            object_in_base[:3, 3],
            arm.approach,
        )
        ranks = sample_grasp_order(arm.rng, scores)
        clear = _filter_clear(tcp_in_base, reachable[ranks], near)
        if arm.approach == "front":  # first grasps whose arm configurations are collision-free
            first_grasps = list(islice(clear, GRASPS_CHECKED))
            arm.planner.set_scene(arm.scene.obstacles(exclude={slot, *movable}))
            ways = np.stack([qpos_before[first_grasps], qpos[first_grasps]], axis=1)
            free = arm.planner.is_free(ways.reshape(-1, 7)).reshape(-1, 2).all(axis=1)
            clear = iter([first_grasps[i] for i in np.argsort(~free, kind="stable")])
        if skip_kinds:
            first_grasps = list(islice(clear, GRASPS_COMPARED))
            clear = (first_grasps[i] for i in _skip_kinds(tcp_in_base[first_grasps], skip_kinds))
        found = False
        for index in islice(clear, GRASPS_PLANNED):
            found = True
            yield tcp_in_base[index]
        if found:
            return
    if any_reachable:
        raise PlanningError("grasp_sampling", "no_clear_grasp")
    raise PlanningError("grasp_sampling", "unreachable" if len(kept) else "no_suitable_grasp")


def retract_from_contact(
    arm: Arm, slot: int, tcp_in_base: Iterable[Array], movable: Collection[int] = ()
) -> list[Array]:
    """Shift grasps back by the smallest of `RETRACTIONS` at which the arm touches nothing but the object.

    The arm may also touch the objects in the slots ``movable``. Grasps for which no shift suffices are omitted. The
    order is that of ``tcp_in_base``, TCP poses (4x4) in the arm's base frame.
    """
    poses = np.array(list(tcp_in_base)).reshape(-1, 4, 4)
    shifted = np.stack([shift_back(poses, distance) for distance in RETRACTIONS], axis=1)  # (N, R, 4, 4)
    solved, qpos = arm.inverse_kinematics.nearest_solutions(shifted, arm.qpos)
    arm.planner.set_scene(arm.scene.obstacles(exclude={slot, *movable}))
    solved[solved] = arm.planner.is_free(qpos[solved], arm.planner.finger_width)
    free = solved.reshape(-1, len(RETRACTIONS))
    return [row[int(np.argmax(ok))] for row, ok in zip(shifted, free, strict=True) if ok.any()]


def _skip_kinds(tcp: Array, count: int) -> list[int]:
    """Return indices of grasps (N, 4, 4) without the first ``count`` kinds.

    Grasps are of the same kind if their TCP poses differ by at most ``KIND_TOLERANCES``.
    """
    left = np.ones(len(tcp), dtype=bool)
    for _ in range(count):
        if not left.any():
            break
        first = tcp[int(np.argmax(left))]
        near = np.linalg.norm(tcp[:, :3, 3] - first[:3, 3], axis=1) <= KIND_TOLERANCES[0]
        turned = [np.abs(tcp[:, :3, axis] @ first[:3, axis]) for axis in (1, 2)]  # the closing axis is symmetric
        left &= ~(near & (np.min(turned, axis=0) >= np.cos(KIND_TOLERANCES[1])))
    return np.flatnonzero(left).tolist()


def _filter_clear(tcp_in_base: Array, order: NDArray[np.int_], points_in_base: Array) -> Iterator[int]:
    """Yield indices of grasps, in ``order``, whose gripper touches no point (P, 3) during the approach."""
    near = select_near_points(tcp_in_base[order], points_in_base)
    for first in range(0, len(order), CLEARED_AT_ONCE):
        some = order[first : first + CLEARED_AT_ONCE]
        yield from some[is_gripper_clear(tcp_in_base[some], near)].tolist()


def _plan_approach_and_exit(
    arm: Arm, slot: int, qpos: Array, tcp_in_base: Array, lift_height: float
) -> tuple[Trajectory, ExitMotions]:
    inward = arm.planner.plan_straight(qpos, tcp_in_base, stage="approach")
    if arm.approach == "top":
        return inward, (arm.plan_first_line(inward.qpos[-1], _lift_poses(tcp_in_base, lift_height), stage="lift"),)
    return inward, _plan_withdrawal(arm, slot, inward.qpos[-1], tcp_in_base)


def _plan_withdrawal(arm: Arm, slot: int, start: Array, tcp_in_base: Array) -> tuple[Trajectory, Trajectory]:
    """Plan a lift and a horizontal line straight back with the object.

    The lift is the smallest one that allows the line.
    """
    failure = PlanningError("withdraw", "no_exit")
    vertices = np.concatenate(arm.env.object_assets[0][slot].hulls)
    held = AttachedBody(vertices, inverse(tcp_in_base) @ arm.scene.object_in_base(slot))
    back = -tcp_in_base[:2, 2] / np.linalg.norm(tcp_in_base[:2, 2])
    for height in FRONT_LIFTS:
        try:
            lift = arm.planner.plan_straight(start, shift_up(tcp_in_base, height), stage="lift")
        except PlanningError as error:
            raise error if height == FRONT_LIFTS[0] else failure from error
        goals = []
        for distance in WITHDRAWALS:
            goals.append(shift_up(tcp_in_base, height))
            goals[-1][:2, 3] += distance * back
        arm.planner.attach(held)
        try:
            return lift, arm.plan_first_line(lift.qpos[-1], goals, stage="withdraw")
        except PlanningError as error:
            failure = error
        finally:
            arm.planner.attach(None)
    raise failure


def _lift_poses(tcp_in_base: Array, lift_height: float) -> list[Array]:
    """Return TCP poses (4x4) after a lift: straight up, back along the approach axis, and between the two."""
    up, back = np.array([0, 0, 1.0]), -tcp_in_base[:3, 2]
    goals = []
    for fraction in (0.0, 0.5, 1.0):
        direction = (1 - fraction) * up + fraction * back
        if direction[2] > 0.2:
            goals.append(tcp_in_base.copy())
            goals[-1][:3, 3] += lift_height / direction[2] * direction
    return goals
