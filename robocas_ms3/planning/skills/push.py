"""Push an object aside with the closed gripper pointing down."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from robocas_ms3.core.errors import PlanningError
from robocas_ms3.core.poses import inverse
from robocas_ms3.planning.executor import CLOSED
from robocas_ms3.planning.protocol import Array, Obstacle, Trajectory
from robocas_ms3.planning.pushes import STAND_OFF, YAWS, Push, generate_push_candidates
from robocas_ms3.planning.skills.arm import Arm, PlannedPrimitive, shift_up

APPROACH_HEIGHT = 0.08  # m above the start of the push; the tool moves straight down from there
LIFT = 0.05  # m after the push (RoboCAS-v0)
SPEED = 0.6  # fraction of the arm's limits during a push, so that objects neither roll far nor jump
PUSHES_TRIED, PUSHES_PLANNED = 24, 3
MAX_FORCE = 30.0  # N; a greater force ejects wedged objects from the heap
RESISTED_SECONDS = 0.1  # s above MAX_FORCE after which a push is stopped
SETTLE_SECONDS = 0.3


@dataclass(frozen=True)
class PushPlan:
    """Motions of a push.

    Attributes:
        approach: motion to the start of the push.
        push: straight horizontal motion along the object.
        lift: motion up and away from the object.
        direction: (3,) horizontal unit vector of the push in the arm's base frame.
    """

    approach: Trajectory
    push: Trajectory
    lift: Trajectory
    direction: Array


def push_away(arm: Arm, slot: int, target: int, *, turn_deg: float = 0.0) -> None:
    """Push an object away from the target, and rise.

    The push stops early if the contact force is too great.

    Args:
        arm: context of the attempt.
        slot: slot of the object to push.
        target: slot of the target.
        turn_deg: rotation of the push from the paper's direction, deg.

    Raises:
        PlanningError: no push can be planned.
    """
    _push(arm, slot, lambda: plan_push(arm, slot, target, turn_deg))


def push_along(arm: Arm, slot: int, push: Push) -> None:
    """Push an object along a given line, and rise.

    Furniture, basket and arm avoid each other; objects do not count as obstacles of the push itself.

    Raises:
        PlanningError: no push can be planned.
    """
    _push(arm, slot, lambda: plan_push_along(arm, push))


def _push(arm: Arm, slot: int, make_plan: Callable[[], PushPlan]) -> None:
    arm.rise_until_free()
    with arm.planning_time():
        plan = make_plan()
        ends = (arm.planner.tcp(motion.qpos[-1]) for motion in (plan.approach, plan.push))
        arm.planned = PlannedPrimitive("push", slot, *ends)
    arm.executor.gripper = CLOSED  # closes during the approach
    arm.follow(plan.approach)
    lift = plan.lift if _execute_push(arm, plan.push, plan.direction) else _plan_lift(arm, plan.direction)
    arm.follow(lift)
    arm.executor.move_gripper(CLOSED, arm.qpos, seconds=SETTLE_SECONDS)


def _execute_push(arm: Arm, push: Trajectory, direction: Array) -> bool:
    """Execute a push; return False if it was stopped because the force exceeded ``MAX_FORCE``."""
    resisted = 0
    ahead = torch.as_tensor(arm.scene.arm_base_in_world[:3, :3] @ direction, dtype=torch.float32)
    for qpos in push.qpos:
        arm.follow(Trajectory(qpos[None], push.dt))
        resistance = -(arm.env.gripper_forces()[0] @ ahead)  # force of each object on each part of the gripper
        resisted = resisted + 1 if float(resistance.clamp(min=0).sum()) > MAX_FORCE else 0
        if resisted * push.dt >= RESISTED_SECONDS - 1e-9:
            return False
    return True


def _plan_lift(arm: Arm, direction: Array) -> Trajectory:
    """Plan a lift after a stopped push, up and back or straight up, that avoids furniture and basket."""
    width, arm.planner.finger_width = arm.planner.finger_width, 0.0
    try:
        arm.planner.set_scene(_fixed_bodies(arm))
        tcp = arm.planner.tcp(arm.qpos)
        return arm.plan_first_line(arm.qpos, [_lift_pose(tcp, direction), shift_up(tcp, LIFT)], stage="push")
    finally:
        arm.planner.finger_width = width


def _lift_pose(tcp_in_base: Array, direction: Array) -> Array:
    back = shift_up(tcp_in_base, LIFT)
    back[:3, 3] -= STAND_OFF * direction
    return back


def _fixed_bodies(arm: Arm) -> list[Obstacle]:
    return arm.scene.obstacles(exclude=range(len(arm.env.objects)))


def plan_push(arm: Arm, slot: int, target: int, turn_deg: float = 0.0) -> PushPlan:
    """Plan the first feasible push of an object.

    The approach avoids all bodies. The push avoids all bodies except the pushed object; if no such push is feasible, it
    avoids only furniture, basket and target. The lift avoids furniture and basket.
    """
    planner = arm.planner
    width, planner.finger_width = planner.finger_width, 0.0
    try:
        starts = _plan_starts(arm, slot, target, turn_deg)
        try:
            return _plan_push_and_lift(arm, starts, movable={slot})
        except PlanningError:
            return _plan_push_and_lift(arm, starts, movable=set(range(len(arm.env.objects))) - {target})
    finally:
        planner.finger_width = width


def plan_push_along(arm: Arm, push: Push) -> PushPlan:
    """Plan a given push, whose motion along the line may touch all objects."""
    planner = arm.planner
    width, planner.finger_width = planner.finger_width, 0.0
    try:
        starts = _plan_lines_down(arm, _filter_reachable(arm, [push]))
        return _plan_push_and_lift(arm, starts, movable=set(range(len(arm.env.objects))))
    finally:
        planner.finger_width = width


def _plan_starts(arm: Arm, slot: int, target: int, turn_deg: float) -> list[tuple[Push, Array, Trajectory]]:
    """Return pushes with a collision-free straight line down to their start.

    Returns:
        For each push: the push, the configuration (7,) above its start, and the line down.
    """
    others = arm.scene.points_in_base(exclude=slot)
    return _plan_lines_down(arm, find_reachable_pushes(arm, slot, target, others, turn_deg))


def _plan_lines_down(arm: Arm, pushes: Iterable[tuple[Push, Array]]) -> list[tuple[Push, Array, Trajectory]]:
    arm.planner.set_scene(arm.scene.obstacles())
    failure, starts = PlanningError("push", "no_free_push"), []
    for push, qpos in pushes:
        try:
            starts.append((push, qpos, arm.planner.plan_straight(qpos, push.start, stage="push")))
        except PlanningError as error:
            failure = error
        if len(starts) == PUSHES_PLANNED:
            break
    if not starts:
        raise failure
    return starts


def _plan_push_and_lift(arm: Arm, starts: list[tuple[Push, Array, Trajectory]], movable: set[int]) -> PushPlan:
    """Plan approach, push and lift for the first direction in which a push is feasible.

    ``movable`` contains the slots of objects that the push may touch.
    """
    planner, failure = arm.planner, PlanningError("push", "no_free_push")
    along_scene, fixed = arm.scene.obstacles(exclude=movable), _fixed_bodies(arm)
    ways: list[tuple[Array, Trajectory, Trajectory, Trajectory]] = []
    first = np.zeros(3)
    for push, qpos, down in starts:
        if ways and push.direction @ first < 1 - 1e-6:
            break
        try:
            planner.set_scene(along_scene)  # movable objects are no obstacles during the push
            along = planner.plan_straight(down.qpos[-1], push.end, stage="push", speed=SPEED)
            planner.set_scene(fixed)  # the pushed object may lean on the tool
            lift = planner.plan_straight(along.qpos[-1], _lift_pose(push.end, push.direction), stage="push")
            ways.append((qpos, down, along, lift))
            first = push.direction
        except PlanningError as error:
            failure = error
    if not ways:
        raise failure
    planner.set_scene(arm.scene.obstacles())
    # same direction, several yaw angles of the tool: use the nearest
    reach = planner.plan_to_qpos(arm.qpos, [way[0] for way in ways], stage="push")
    _, down, along, lift = min(ways, key=lambda way: float(np.abs(way[0] - reach.qpos[-1]).max()))
    return PushPlan(planner.join(arm.qpos, reach, down), along, lift, direction=first)


def find_reachable_pushes(
    arm: Arm, slot: int, target: int, others: Array, turn_deg: float = 0.0
) -> Iterator[tuple[Push, Array]]:
    """Yield pushes that the arm reaches, with the configuration (7,) above their start.

    Pushes in the paper's direction come first.

    ``others`` (Q, 3) has surface points of all bodies except the pushed object.
    """
    points, middle = arm.scene.object_points(slot), arm.scene.object_points(target).mean(axis=0)
    fixed = arm.scene.points_in_base(exclude=range(len(arm.env.objects)))
    pushes = list(generate_push_candidates(arm.rng, points, middle, others, read_surface(arm), fixed, turn_deg))
    yield from _filter_reachable(arm, pushes)


def _filter_reachable(arm: Arm, pushes: Sequence[Push]) -> Iterator[tuple[Push, Array]]:
    if not pushes:
        return
    starts, ends = np.stack([push.start for push in pushes]), np.stack([push.end for push in pushes])
    reachable, qpos = arm.inverse_kinematics.nearest_solutions(shift_up(starts, APPROACH_HEIGHT), arm.qpos)
    for poses in (starts, ends):
        reachable[reachable] = arm.inverse_kinematics.nearest_solutions(poses[reachable], arm.qpos)[0]
    turn = np.arange(len(pushes)) // YAWS
    order = np.lexsort((np.abs(qpos - arm.qpos).max(axis=1), turn))
    yield from [(pushes[i], qpos[i]) for i in order if reachable[i]][:PUSHES_TRIED]


def read_surface(arm: Arm) -> tuple[Array, Array]:
    """Return the surface on which the objects stand: pose (4x4) of its centre and half size (2,) in m."""
    model = arm.env.model
    config = model.config.surface
    surface = model.furniture[config.furniture].asset.surfaces[config.name]
    low, high = np.array(surface.min_xy), np.array(surface.max_xy)
    frame = inverse(arm.scene.arm_base_in_world) @ model.support_pose @ model.support_motion(opened=True)
    frame[:3, 3] += frame[:3, :3] @ np.append((low + high) / 2, surface.z)
    return frame, (high - low) / 2
