"""Grasp an object by one of its annotated grasps and take it out of its surroundings.

From above: lift it. From the front: lift it a little, then withdraw straight back, so that neighbours stay standing.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from robocas_ms3.errors import PlanningFailed
from robocas_ms3.planning.protocol import Array, AttachedBody, Trajectory
from robocas_ms3.planning.scene import inverse
from robocas_ms3.planning.skills.arm import Arm, moved_back, raised
from robocas_ms3.scenes.grasping import NEIGHBOURHOOD, PREGRASP_DISTANCE, Approach, filter_grasps, rank_grasps
from robocas_ms3.scenes.placement import transform

GRASPS_CHECKED = 48  # grasps of which a check of collisions says whether to try them early
GRASPS_PLANNED = 12  # grasps that motions are planned for before an attempt gives up
# m; the least makes a stage of the tasks (3 cm), the others go over what stands in front: the first with a way out
FRONT_LIFTS = (0.04, 0.08, 0.14, 0.2)
WITHDRAWALS = (0.25, 0.18, 0.12)  # m, straight back; the first one that can be reached


Entry = tuple[Array, Trajectory, tuple[Trajectory, ...]]  # pre-grasp configuration, way in, way out


@dataclass(frozen=True)
class GraspPlan:
    """Motions from where the arm is to a grasped object that is clear of its surroundings."""

    reach: Trajectory
    approach: Trajectory
    retreat: tuple[Trajectory, ...]


def grasp(arm: Arm, slot: int, *, lift_height: float = 0.10, approach: Approach | None = None) -> None:
    """Plan a grasp of an object, run it, and lift (from the front: lift and withdraw) the object.

    Args:
        arm: the attempt's tools.
        slot: of the object.
        lift_height: when grasping from above, m (upstream: 0.10 when picking, 0.15 when searching).
        approach: from where the gripper comes; default: as the configuration says.

    Raises:
        PlanningFailed: no grasp can be planned, or the object was missed or slipped.
    """
    with arm.planning():
        plan = plan_grasp(arm, slot, lift_height, approach or arm.env.task_config.target.approach)
    arm.follow(plan.reach, plan.approach)
    arm.close_gripper()
    if not arm.holds(slot):
        raise PlanningFailed("grasp", "missed")
    arm.follow(*plan.retreat)
    if not arm.holds(slot):
        raise PlanningFailed("lift", "slipped")


def plan_grasp(arm: Arm, slot: int, lift_height: float, approach: Approach = "top") -> GraspPlan:
    """Plan the best grasp that has a way in and out.

    Raises:
        PlanningFailed: of the grasp that came last.
    """
    everything, others = arm.scene.obstacles(), arm.scene.obstacles(without=slot)
    failure = PlanningFailed("grasp_sampling", "no_feasible_grasp")
    for tcp_in_base in candidates(arm, slot, approach):
        try:
            # in and out of the target's surroundings, where the target itself is no obstacle ...
            arm.planner.set_scene(others)
            entries = _entries(arm, slot, tcp_in_base, lift_height, approach)
            # ... and there with the target as one
            arm.planner.set_scene(everything)
            reach = arm.planner.plan_to_qpos(arm.at, [entry[0] for entry in entries], stage="reach")
        except PlanningFailed as error:
            failure = error
            continue
        chosen = min(entries, key=lambda entry: float(np.abs(entry[0] - reach.qpos[-1]).max()))
        return GraspPlan(reach, chosen[1], chosen[2])
    raise failure


def candidates(arm: Arm, slot: int, approach: Approach = "top") -> Iterator[Array]:
    """Grasps worth planning for, best first: TCP poses 4x4.

    Args:
        arm: the attempt's tools.
        slot: of the object.
        approach: from where the gripper may come.

    Raises:
        PlanningFailed: no grasp passes the filters, or none can be reached.
    """
    notes = arm.env.object_assets[0][slot].annotations
    base, object_in_base = arm.scene.arm_base_in_world, arm.scene.object_in_base(slot)
    near = arm.scene.obstacles_in_base(without=slot, radius=NEIGHBOURHOOD, around=object_in_base[:3, 3])
    kept = filter_grasps(
        base @ object_in_base @ notes.grasps_tcp_in_object,
        notes.grasp_widths,
        arm_base_in_world=base,
        object_center_in_world=(base @ object_in_base)[:3, 3],
        scene_points_in_world=transform(base, near),
        qualities=1.1 - notes.grasp_qualities,  # upstream's scale: more is better
        approach=approach,
    )
    tcp_in_base = inverse(base) @ kept.tcp_in_world
    if not len(tcp_in_base):
        raise PlanningFailed("grasp_sampling", "all_filtered")
    pregrasp = tcp_in_base.copy()
    pregrasp[:, :3, 3] -= PREGRASP_DISTANCE * pregrasp[:, :3, 2]
    solved, qpos = arm.reachability.reachable(tcp_in_base, arm.at)
    solved_before, qpos_before = arm.reachability.reachable(pregrasp, arm.at)
    reachable = solved & solved_before
    if not reachable.any():
        raise PlanningFailed("grasp_sampling", "unreachable")
    order = rank_grasps(
        tcp_in_base[reachable],
        kept.qualities[reachable],
        object_center=object_in_base[:3, 3],
        qpos=qpos[reachable],
        near=arm.at,
        rng=arm.rng,
        approach=approach,
    )
    if approach == "front":  # where it is narrow, first those whose arm is free as inverse kinematics found it
        order = order[:GRASPS_CHECKED]
        arm.planner.set_scene(arm.scene.obstacles(without=slot))
        ways = np.stack([qpos_before[reachable], qpos[reachable]], axis=1)[order]
        free = arm.planner.free(ways.reshape(-1, 7)).reshape(-1, 2).all(axis=1)
        order = order[np.argsort(~free, kind="stable")]
    for index in order[:GRASPS_PLANNED]:
        yield tcp_in_base[reachable][index]


def _entries(arm: Arm, slot: int, tcp_in_base: Array, lift_height: float, approach: Approach) -> list[Entry]:
    """Pre-grasp configurations from which straight approach and way out are free, nearest first."""
    failure = PlanningFailed("approach", "no_ik")
    entries: list[Entry] = []
    for qpos in arm.planner.ik(moved_back(tcp_in_base, PREGRASP_DISTANCE), arm.at)[:4]:
        try:
            inward = arm.planner.plan_straight(qpos, tcp_in_base, stage="approach")
            if approach == "top":
                retreat = (arm.first_line(inward.qpos[-1], _ways_up(tcp_in_base, lift_height), stage="lift"),)
            else:
                retreat = _plan_withdrawal(arm, slot, inward.qpos[-1], tcp_in_base)
        except PlanningFailed as error:
            failure = error
            continue
        entries.append((qpos, inward, retreat))
    if not entries:
        raise failure
    return entries


def _plan_withdrawal(arm: Arm, slot: int, start: Array, tcp_in_base: Array) -> tuple[Trajectory, Trajectory]:
    """Plan straight up, as little as leaves a way out, and from there straight and level back with the object.

    While it is lifted the object is no part of the check, since at first it stands on something; whether it hits what
    is above shows where the way back begins.

    Raises:
        PlanningFailed: of the lift that came last.
    """
    failure = PlanningFailed("withdraw", "no_way_out")
    vertices = np.concatenate(arm.env.object_assets[0][slot].hulls)
    held = AttachedBody(vertices, inverse(tcp_in_base) @ arm.scene.object_in_base(slot))
    back = -tcp_in_base[:2, 2] / np.linalg.norm(tcp_in_base[:2, 2])
    for height in FRONT_LIFTS:
        try:
            lift = arm.planner.plan_straight(start, raised(tcp_in_base, height), stage="lift")
        except PlanningFailed as error:
            raise error if height == FRONT_LIFTS[0] else failure from error
        goals = []
        for distance in WITHDRAWALS:
            goals.append(raised(tcp_in_base, height))
            goals[-1][:2, 3] += distance * back
        arm.planner.attach(held)
        try:
            return lift, arm.first_line(lift.qpos[-1], goals, stage="withdraw")
        except PlanningFailed as error:
            failure = error
        finally:
            arm.planner.attach(None)
    raise failure


def _ways_up(tcp_in_base: Array, lift_height: float) -> list[Array]:
    """Where to lift to: straight up, or between that and back the way the gripper came in."""
    up, back = np.array([0, 0, 1.0]), -tcp_in_base[:3, 2]
    goals = []
    for share in (0.0, 0.5, 1.0):
        direction = (1 - share) * up + share * back
        if direction[2] > 0.2:
            goals.append(tcp_in_base.copy())
            goals[-1][:3, 3] += lift_height / direction[2] * direction
    return goals
