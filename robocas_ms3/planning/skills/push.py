"""Push an object aside with the closed gripper, tool pointing down."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch

from robocas_ms3.core.errors import PlanningError
from robocas_ms3.core.poses import inverse
from robocas_ms3.planning.executor import CLOSED
from robocas_ms3.planning.protocol import Array, Obstacle, Trajectory
from robocas_ms3.planning.pushes import STAND_OFF, YAWS, Push, push_candidates
from robocas_ms3.planning.skills.arm import Arm, shift_up

APPROACH_HEIGHT = 0.08  # m above the start of the push, from where the tool comes straight down
LIFT = 0.05  # m after the push (upstream's)
SPEED = 0.6  # of the arm's limits while pushing: what is pushed neither rolls far nor jumps
PUSHES_TRIED, PUSHES_PLANNED = 24, 6
MAX_FORCE = 30.0  # N; pushed harder, objects wedged against others are shot out of the heap
RESISTED_SECONDS = 0.1  # of more than that after which a push is cut short
SETTLE_SECONDS = 0.3


@dataclass(frozen=True)
class PushPlan:
    """Motions from where the arm is to clear of the pushed object."""

    way_in: Trajectory
    push: Trajectory
    lift: Trajectory
    direction: Array


def push_away(arm: Arm, slot: int, target: int, *, turn_deg: float = 0.0) -> None:
    """Push an object away from the target until it has moved far enough or resists, then rise."""
    arm.rise_until_free()
    with arm.planning_time():
        plan = plan_push(arm, slot, target, turn_deg)
    arm.executor.gripper = CLOSED  # it closes on the way
    arm.follow(plan.way_in)
    lift = plan.lift if _execute_push(arm, plan.push, plan.direction) else _plan_lift(arm, plan.direction)
    arm.follow(lift)
    arm.executor.move_gripper(CLOSED, arm.qpos, seconds=SETTLE_SECONDS)


def _execute_push(arm: Arm, push: Trajectory, direction: Array) -> bool:
    """Run a push step by step; False where it was cut short, since what was pushed resisted."""
    resisted = 0
    ahead = torch.as_tensor(arm.scene.arm_base_in_world[:3, :3] @ direction, dtype=torch.float32)
    for qpos in push.qpos:
        arm.follow(Trajectory(qpos[None], push.dt))
        against = -(arm.env.gripper_forces()[0] @ ahead)  # what each object does to each part of the gripper
        resisted = resisted + 1 if float(against.clamp(min=0).sum()) > MAX_FORCE else 0
        if resisted * push.dt >= RESISTED_SECONDS - 1e-9:
            return False
    return True


def _plan_lift(arm: Arm, direction: Array) -> Trajectory:
    """Plan up and back, or straight up, from where a push was cut short, clear of furniture and basket."""
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
    """Plan the first push that has a way in; one that would move other objects only where there is no other.

    The way to the object is clear of everything, the way along of furniture, basket and target, and the way up of
    furniture and basket.
    """
    planner = arm.planner
    width, planner.finger_width = planner.finger_width, 0.0
    try:
        starts = _plan_starts(arm, slot, target, turn_deg)
        try:
            return _plan_along(arm, starts, movable={slot})
        except PlanningError:
            return _plan_along(arm, starts, movable=set(range(len(arm.env.objects))) - {target})
    finally:
        planner.finger_width = width


def _plan_starts(arm: Arm, slot: int, target: int, turn_deg: float) -> list[tuple[Push, Array, Trajectory]]:
    """Return pushes with a free way down to the object: with a configuration (7,) above, and that way."""
    arm.planner.set_scene(arm.scene.obstacles())
    failure, starts = PlanningError("push", "no_room"), []
    for push, qpos in reachable_pushes(arm, slot, target, arm.scene.points_in_base(exclude=slot), turn_deg):
        try:
            starts.append((push, qpos, arm.planner.plan_straight(qpos, push.start, stage="push")))
        except PlanningError as error:
            failure = error
        if len(starts) == PUSHES_PLANNED:
            break
    if not starts:
        raise failure
    return starts


def _plan_along(arm: Arm, starts: list[tuple[Push, Array, Trajectory]], movable: set[int]) -> PushPlan:
    """Plan on from where pushes begin, with some objects that may be moved on the way along."""
    planner, failure = arm.planner, PlanningError("push", "no_room")
    along_scene, fixed = arm.scene.obstacles(exclude=movable), _fixed_bodies(arm)
    ways: list[tuple[Array, Trajectory, Trajectory, Trajectory]] = []
    first = np.zeros(3)
    for push, qpos, down in starts:
        if ways and push.direction @ first < 1 - 1e-6:
            break
        try:
            planner.set_scene(along_scene)  # what may move is no obstacle on the way along
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
    # one direction, several turns of the tool: the one that is nearest
    reach = planner.plan_to_qpos(arm.qpos, [way[0] for way in ways], stage="push")
    _, down, along, lift = min(ways, key=lambda way: float(np.abs(way[0] - reach.qpos[-1]).max()))
    return PushPlan(planner.join(arm.qpos, reach, down), along, lift, direction=first)


def reachable_pushes(
    arm: Arm, slot: int, target: int, others: Array, turn_deg: float = 0.0
) -> Iterator[tuple[Push, Array]]:
    """Yield pushes within reach and a configuration (7,) above each start: the paper's direction first."""
    points, middle = arm.scene.object_points(slot), arm.scene.object_points(target).mean(axis=0)
    fixed = arm.scene.points_in_base(exclude=range(len(arm.env.objects)))
    pushes = list(push_candidates(arm.rng, points, middle, others, surface_in_base(arm), fixed, turn_deg))
    if not pushes:
        return
    starts, ends = np.stack([push.start for push in pushes]), np.stack([push.end for push in pushes])
    reachable, qpos = arm.reachability.nearest_solutions(shift_up(starts, APPROACH_HEIGHT), arm.qpos)
    for poses in (starts, ends):
        reachable[reachable] = arm.reachability.nearest_solutions(poses[reachable], arm.qpos)[0]
    turn = np.repeat(np.arange(len(pushes) // YAWS), YAWS)
    order = np.lexsort((np.abs(qpos - arm.qpos).max(axis=1), turn))
    yield from [(pushes[i], qpos[i]) for i in order if reachable[i]][:PUSHES_TRIED]


def surface_in_base(arm: Arm) -> tuple[Array, Array]:
    """Return the middle (4x4) of the surface that objects are on, and its half size (2,) m."""
    model = arm.env.model
    config = model.config.surface
    surface = model.furniture[config.furniture].asset.surfaces[config.name]
    low, high = np.array(surface.min_xy), np.array(surface.max_xy)
    frame = inverse(arm.scene.arm_base_in_world) @ model.support_pose @ model.support_motion(opened=True)
    frame[:3, 3] += frame[:3, :3] @ np.append((low + high) / 2, surface.z)
    return frame, (high - low) / 2
