"""Carry a held object above the basket, let go of it, step back."""

from __future__ import annotations

import numpy as np

from robocas_ms3.errors import PlanningFailed
from robocas_ms3.planning.drops import overhangs, sample_drops
from robocas_ms3.planning.protocol import Array, AttachedBody, Trajectory
from robocas_ms3.planning.scene import inverse
from robocas_ms3.planning.skills.arm import Arm, moved_back, raised
from robocas_ms3.scenes.placement import transform

DROPS_SAMPLED, DROPS_PLANNED = 192, 10
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
        arm.planner.set_scene(arm.scene.obstacles_in_base(without=slot))
        retreat = _plan_retreat(arm, start, arm.planner.tcp(start))
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
    asset = arm.env.object_assets[0][slot]
    object_in_tcp = inverse(scene.tcp_in_base) @ scene.object_in_base(slot)
    vertices = np.concatenate(asset.hulls)
    vertices_in_tcp = transform(object_in_tcp, vertices)
    inner = arm.env.model.basket.asset.inner
    assert inner is not None  # the environment saw to it
    drops = sample_drops(
        arm.rng,
        count=DROPS_SAMPLED,
        container_in_base=scene.basket_in_base,
        inner_low=np.array(inner.min),
        inner_high=np.array(inner.max),
        vertices_in_tcp=vertices_in_tcp,
        center_in_tcp=transform(object_in_tcp, np.array([asset.asset.center_of_mass]))[0],
    )
    solved, qpos = arm.reachability.reachable(drops, start)
    if not solved.any():
        raise PlanningFailed("transfer", "unreachable")
    drops, qpos = drops[solved], qpos[solved]
    # first those in which the object fits through the opening, then those that are near
    overhang = overhangs(drops, scene.basket_in_base, np.array(inner.min), np.array(inner.max), vertices_in_tcp)
    order = np.lexsort((np.abs(qpos - start).max(axis=1), np.ceil(overhang / 0.02)))
    arm.planner.set_scene(scene.obstacles_in_base(without=slot))
    arm.planner.attach(AttachedBody(vertices, object_in_tcp))
    arm.planner.finger_width = float(arm.env.agent.gripper_width[0])
    failure = PlanningFailed("transfer", "no_plan")
    for index in order[:DROPS_PLANNED]:
        try:
            carry = arm.planner.plan_to_pose(start, drops[index], stage="transfer")
            _plan_retreat(arm, carry.qpos[-1], drops[index])  # no way up from there: no place to let go
            return carry
        except PlanningFailed as error:
            failure = error
    raise failure


def _plan_retreat(arm: Arm, start: Array, tcp_in_base: Array) -> Trajectory:
    back = moved_back(tcp_in_base, RETREAT_HEIGHT)
    up = RETREAT_HEIGHT
    goals = [raised(tcp_in_base, up), back, raised(back, up / 2), raised(tcp_in_base, up / 2)]
    return arm.first_line(start, goals, stage="retreat", check_collisions=False)


def _why_not(arm: Arm) -> str:
    measures = arm.env.target_measures()
    for reason in ("in_basket", "untouched", "at_rest", "basket_stands"):
        if not bool(measures[reason][0]):
            return f"not_{reason}"
    return "unstable"
