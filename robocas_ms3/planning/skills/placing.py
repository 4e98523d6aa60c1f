"""Carry a held object above the basket, let go of it, step back."""

from __future__ import annotations

import numpy as np

from robocas_ms3.errors import PlanningFailed
from robocas_ms3.planning.chain import turn_between
from robocas_ms3.planning.drops import overhangs, sample_drops
from robocas_ms3.planning.protocol import Array, AttachedBody, Trajectory
from robocas_ms3.planning.scene import inverse, matrix
from robocas_ms3.planning.skills.arm import Arm, moved_back, raised
from robocas_ms3.planning.skills.retreating import plan_step_back
from robocas_ms3.scenes.placement import transform

DROPS_SAMPLED, DROPS_CHECKED, DROPS_PLANNED = 192, 64, 10
DROP_MARGIN = 0.025  # m
LEAN_WEIGHT = 0.7  # rad of a joint that a rad of the gripper's is worth
RETREAT_HEIGHT = 0.05  # m, upstream's


def carry_to_basket(arm: Arm, slot: int) -> None:
    """Carry a held object to where it hangs above the basket.

    Raises:
        PlanningFailed: no way there, or the object was lost.
    """
    with arm.planning():
        motion = plan_carry(arm, slot)
    arm.follow(motion)
    if not arm.holds(slot):
        raise PlanningFailed("transfer", "dropped")


def release_into_basket(arm: Arm, slot: int) -> None:
    """Open the gripper, step back and go home until the task has succeeded.

    Raises:
        PlanningFailed: no way back, or the object did not end up as it should.
    """
    start = arm.at
    arm.open_gripper()
    with arm.planning():
        arm.hold_nothing()
        arm.planner.set_scene(arm.scene.obstacles(without=slot))
        retreat = plan_step_back(arm, start, _ways_off(arm.planner.tcp(start)))
        home = arm.plan_home(retreat.qpos[-1])
    arm.follow(retreat)
    # The object settles while the arm goes home; the demonstration ends as soon as it lies still.
    if not arm.follow(home, until="success"):
        raise PlanningFailed("release", _why_not(arm))


def plan_carry(arm: Arm, slot: int) -> Trajectory:
    """Plan from where the arm is to a pose above the basket from which it can also step back.

    Raises:
        PlanningFailed: of the pose that came last.
    """
    scene, start = arm.scene, arm.at
    drops = drop_poses(arm, slot, scene.arm_base_in_world)
    solved, qpos = arm.reachability.reachable(drops, start)
    if not solved.any():
        raise PlanningFailed("transfer", "unreachable")
    drops, qpos = drops[solved], qpos[solved]
    # first those in which the object fits through the opening with room to spare, then those that are near; off a steep
    # gripper it falls straight, off a leaning one it slides
    low, high = _inner_box(arm)
    margin = np.array([DROP_MARGIN, DROP_MARGIN, 0])
    overhang = overhangs(drops, scene.basket_in_base, low + margin, high - margin, transform(*held_object(arm, slot)))
    lean = np.arccos(np.clip(-drops[:, 2, 2], -1, 1))
    order = np.lexsort((turn_between(qpos, start) + LEAN_WEIGHT * lean, np.ceil(overhang / 0.015)))
    arm.planner.set_scene(scene.obstacles(without=slot))
    attach_held(arm, slot)
    order = order[:DROPS_CHECKED]
    order = order[arm.planner.free(qpos[order], arm.planner.finger_width)][:DROPS_PLANNED]
    if not len(order):
        raise PlanningFailed("transfer", "no_free_place")
    for index in order:
        try:
            carry = arm.planner.plan_to_qpos(start, [qpos[index]], stage="transfer", search=False)
            plan_step_back(arm, carry.qpos[-1], _ways_off(drops[index]))  # no way up from there: no place to let go
            return carry
        except PlanningFailed:
            continue
    failure = PlanningFailed("transfer", "no_plan")
    for _ in range(len(order)):
        carry = arm.planner.plan_to_qpos(start, list(qpos[order]), stage="transfer")
        chosen = int(np.argmin(np.abs(qpos[order] - carry.qpos[-1]).max(axis=1)))
        try:
            plan_step_back(arm, carry.qpos[-1], _ways_off(drops[order[chosen]]))
            return carry
        except PlanningFailed as error:
            failure, order = error, np.delete(order, chosen)
    raise failure


def held_object(arm: Arm, slot: int) -> tuple[Array, Array]:
    """4x4 of an object in the frame of the TCP that holds it, and the vertices (V, 3) of its hulls in its own, m."""
    vertices = np.concatenate(arm.env.object_assets[0][slot].hulls)
    return inverse(arm.scene.tcp_in_base) @ arm.scene.object_in_base(slot), vertices


def attach_held(arm: Arm, slot: int) -> None:
    """Tell the planner what the gripper holds, as it holds it right now."""
    object_in_tcp, vertices = held_object(arm, slot)
    arm.planner.attach(AttachedBody(vertices, object_in_tcp))
    arm.planner.finger_width = float(arm.env.agent.gripper_width[0])


def drop_poses(arm: Arm, slot: int, arm_base_in_world: Array) -> Array:
    """Poses (N, 4, 4) of the TCP that bring the object it holds above the basket.

    Args:
        arm: the attempt's tools.
        slot: of the held object.
        arm_base_in_world: 4x4, in whose frame the poses are: where the arm's base is, or might be.
    """
    object_in_tcp, vertices = held_object(arm, slot)
    low, high = _inner_box(arm)
    return sample_drops(
        arm.rng,
        count=DROPS_SAMPLED,
        container_in_base=inverse(arm_base_in_world) @ matrix(arm.env.fixtures.basket.pose.raw_pose[0]),
        inner_low=low,
        inner_high=high,
        vertices_in_tcp=transform(object_in_tcp, vertices),
        center_in_tcp=transform(object_in_tcp, np.array([arm.env.object_assets[0][slot].asset.center_of_mass]))[0],
    )


def _inner_box(arm: Arm) -> tuple[Array, Array]:
    """Least and greatest corner (3,) of the room inside the basket, in its frame, m."""
    inner = arm.env.model.basket.asset.inner
    assert inner is not None  # the environment saw to it
    return np.array(inner.min), np.array(inner.max)


def _ways_off(tcp_in_base: Array) -> list[Array]:
    """Where to step back to above the basket: up, back, or between."""
    back, up = moved_back(tcp_in_base, RETREAT_HEIGHT), RETREAT_HEIGHT
    return [raised(tcp_in_base, up), back, raised(back, up / 2), raised(tcp_in_base, up / 2)]


def _why_not(arm: Arm) -> str:
    for measure, reached in arm.env.target_measures().items():
        if not bool(reached[0]):
            return f"not_{measure}"
    return "unstable"
