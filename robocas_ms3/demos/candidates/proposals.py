"""Propose random candidates of a decision: grasps, pushes and lifts of any object, releases, and pulls.

Random candidates represent failures, which the scripted policy avoids. *Near misses* have an error of position or
angle.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from robocas_ms3.core.poses import inverse
from robocas_ms3.demos.candidates.schema import DecisionKind, Primitive, Source
from robocas_ms3.planning.executor import OPEN
from robocas_ms3.planning.protocol import Array
from robocas_ms3.planning.pushes import (
    BELOW_TOP,
    STAND_OFF,
    TIP_BELOW_TCP,
    TIP_CLEARANCE,
    TOOL_RADIUS,
    YAWS,
    does_tool_fit,
    push_yaws,
)
from robocas_ms3.planning.skills.arm import Arm, shift_back
from robocas_ms3.planning.skills.grasp import grasp
from robocas_ms3.planning.skills.handles import MovingPart, pull_handle
from robocas_ms3.planning.skills.place import carry_and_release, sample_drop_poses
from robocas_ms3.planning.skills.push import push_along, read_surface
from robocas_ms3.planning.skills.remove import remove_object, sample_suitable_grasps
from robocas_ms3.scenes.grasp_checks import HALF_TURN, NEIGHBOURHOOD, PREGRASP_DISTANCE, is_gripper_clear

# probability of each primitive, by kind of decision
MIX: dict[DecisionKind, dict[Primitive, float]] = {
    "move": {"push": 0.4, "lift": 0.25, "grasp": 0.35},
    "grasp": {"grasp": 0.7, "push": 0.3},
    "release": {"release": 1.0},
    "pull": {"pull": 1.0},
}
TARGET_FRACTION = 0.5  # fraction of random grasps that are of the target
NEIGHBOUR_DISTANCE = 0.15  # m from the target at which an object is chosen e times less often than the target
CLEAR_FRACTION = 0.6  # fraction of random grasps that touch no other body, if there are any
LIFT_OBJECTS = 4  # objects to draw until one can be lifted without contact between the gripper and another body
REACHABLE_FRACTION = 0.9  # fraction of random candidates whose start is reachable or free, if there is one
GRASPS_DRAWN = 8  # grasps to draw until one is reachable and, for a near miss, touches no other body
# errors of near misses: standard deviations across and along the approach in m, and in rad
GRASP_SHIFT, GRASP_DEPTH, GRASP_TURN = 0.02, 0.012, np.deg2rad(15)
PUSH_SHIFT = (0.02, 0.05)  # m across the direction of the push, minimum and maximum
PUSH_STARTS = 8  # starts to draw until the tool is free at the start
PUSH_LENGTHS = (0.04, 0.2)  # m, of a random push after the contact
DROP_SHIFT = (0.06, 0.26)  # m, horizontally
PULL_SHIFT, PULL_ERROR = 0.004, (0.015, 0.05)  # m: standard deviation of random pulls; length of the error of a miss


@dataclass(frozen=True)
class Candidate:
    """Candidate of a decision.

    Attributes:
        source: origin of the candidate.
        primitive: what the arm does.
        slot: slot of the object; -1 for a pull.
        run: function that plans and executes the candidate; it raises PlanningError if that fails.
        start_in_base: (4x4) TCP pose at the start, as in `PlannedPrimitive`; None before it is planned.
        end_in_base: (4x4) TCP pose at the end of a push; None for other primitives, or before it is planned.
        option: number of the scripted policy's candidate in its decision; None for random candidates.
    """

    source: Source
    primitive: Primitive
    slot: int
    run: Callable[[], object]
    start_in_base: Array | None = None
    end_in_base: Array | None = None
    option: int | None = None


def propose(
    arm: Arm, kind: DecisionKind, count: int, rng: np.random.Generator, near_miss_fraction: float
) -> list[Candidate]:
    """Return up to ``count`` random candidates for a decision, in the present state of the scene.

    Args:
        arm: context of the attempt, which does not change.
        kind: kind of the decision.
        count: number of candidates; a candidate is left out if its object has no annotated grasp.
        rng: random generator.
        near_miss_fraction: fraction of candidates with a position error.
    """
    mix = dict(MIX[kind])
    if arm.approach == "front":  # the closed gripper cannot point down into a shelf
        mix.pop("push", None)
    weights = np.array(list(mix.values()))
    primitives = rng.choice(list(mix), size=count, p=weights / weights.sum()).tolist()
    makers = {"grasp": _grasp, "push": _push, "lift": _lift, "release": _release, "pull": _pull}
    own, arm.rng = arm.rng, rng  # the episode must not depend on the proposals
    try:
        made = [makers[primitive](arm, rng, bool(rng.random() < near_miss_fraction)) for primitive in primitives]
    finally:
        arm.rng = own
    return [candidate for candidate in made if candidate is not None]


def _draw_slot(arm: Arm, rng: np.random.Generator, *, with_target: bool) -> int | None:
    """Draw an object near the target; None if there is no other object."""
    present = np.flatnonzero(arm.env.present[0].cpu().numpy())
    slots = present if with_target else present[present != arm.target]
    if not len(slots):
        return None
    positions = np.stack([arm.scene.object_in_base(slot)[:3, 3] for slot in slots.tolist()])
    distances = np.linalg.norm(positions - arm.scene.object_in_base(arm.target)[:3, 3], axis=1)
    weights = np.exp(-distances / NEIGHBOUR_DISTANCE) + 1e-6
    return int(rng.choice(slots, p=weights / weights.sum()))


def _draw_grasp(arm: Arm, rng: np.random.Generator, slot: int, near_miss: bool, *, clear_only: bool) -> Array | None:
    """Draw an annotated grasp (4x4) of an object, in the arm's base frame.

    Args:
        arm: context of the attempt.
        rng: random generator.
        slot: slot of the object.
        near_miss: whether the grasp has an error.
        clear_only: whether the gripper must touch no other body.

    Returns:
        The grasp; None if there is none.
    """
    grasps = sample_suitable_grasps(arm, slot)
    around = arm.scene.object_in_base(slot)[:3, 3]
    near = arm.scene.points_in_base(exclude=slot, radius=NEIGHBOURHOOD, around=around)
    if clear_only:
        grasps = grasps[is_gripper_clear(grasps, near)]
    if not len(grasps):
        return None
    drawn = grasps[rng.permutation(len(grasps))[:GRASPS_DRAWN]]
    turned = rng.random(len(drawn)) < 0.5
    drawn = np.where(turned[:, None, None], drawn @ HALF_TURN, drawn)
    if near_miss:
        drawn = drawn @ _draw_errors(rng, len(drawn))
        clear = is_gripper_clear(drawn, near)
        drawn = drawn[clear] if clear.any() else drawn
    return _prefer_reachable(arm, rng, drawn, shift_back(drawn, PREGRASP_DISTANCE))[0]


def _draw_errors(rng: np.random.Generator, count: int) -> Array:
    """Draw errors (count, 4, 4) of near misses, in the TCP frame."""
    errors = np.tile(np.eye(4), (count, 1, 1))
    errors[:, :3, :3] = Rotation.from_rotvec(rng.normal(scale=GRASP_TURN, size=(count, 3))).as_matrix()
    errors[:, :3, 3] = rng.normal(size=(count, 3)) * (GRASP_SHIFT, GRASP_SHIFT, GRASP_DEPTH)
    return errors


def _prefer_reachable(arm: Arm, rng: np.random.Generator, poses: Array, starts: Array) -> Array:
    """Return the reachable ones of TCP poses (N, 4, 4), or all of them with probability ``1 - REACHABLE_FRACTION``.

    A pose is reachable if inverse kinematics has a solution for it and for its pose in ``starts`` (N, 4, 4).
    """
    if rng.random() > REACHABLE_FRACTION:
        return poses
    reachable = arm.inverse_kinematics.nearest_solutions(poses, arm.qpos)[0]
    if starts is not poses:
        reachable &= arm.inverse_kinematics.nearest_solutions(starts, arm.qpos)[0]
    return poses[reachable] if reachable.any() else poses


def _grasp(arm: Arm, rng: np.random.Generator, near_miss: bool) -> Candidate | None:
    slot = arm.target if rng.random() < TARGET_FRACTION else _draw_slot(arm, rng, with_target=False)
    if slot is None:
        return None
    pose = _draw_grasp(arm, rng, slot, near_miss, clear_only=rng.random() < CLEAR_FRACTION)
    if pose is None:
        pose = _draw_grasp(arm, rng, slot, near_miss, clear_only=False)
    if pose is None:
        return None

    def run() -> None:
        if arm.approach == "top":
            arm.rise_until_free()
        arm.executor.gripper = OPEN
        grasp(arm, slot, grasps=[pose])

    return Candidate("near_miss" if near_miss else "random", "grasp", slot, run, pose)


def _lift(arm: Arm, rng: np.random.Generator, near_miss: bool) -> Candidate | None:
    slot = pose = None
    for _ in range(LIFT_OBJECTS):
        slot = _draw_slot(arm, rng, with_target=False)
        pose = None if slot is None else _draw_grasp(arm, rng, slot, near_miss, clear_only=True)
        if pose is not None:
            break
    if slot is None or pose is None:
        return None

    def run() -> None:
        arm.rise_until_free()
        arm.executor.gripper = OPEN
        remove_object(arm, slot, grasps=[pose])

    return Candidate("near_miss" if near_miss else "random", "lift", slot, run, pose)


def _push(arm: Arm, rng: np.random.Generator, near_miss: bool) -> Candidate | None:
    slot = _draw_slot(arm, rng, with_target=True)
    assert slot is not None  # the target is present
    points, others = arm.scene.object_points(slot), arm.scene.points_in_base(exclude=slot)
    lowest = read_surface(arm)[0][2, 3] + TIP_CLEARANCE + TIP_BELOW_TCP
    tool, direction = draw_push_start(rng, points, lowest, near_miss)
    for _ in range(PUSH_STARTS if rng.random() < REACHABLE_FRACTION else 0):  # prefer a free start
        if does_tool_fit(tool, others):
            break
        tool, direction = draw_push_start(rng, points, lowest, near_miss)
    push = push_yaws(tool, direction, STAND_OFF + rng.uniform(*PUSH_LENGTHS))[int(rng.integers(YAWS))]
    source: Source = "near_miss" if near_miss else "random"
    return Candidate(source, "push", slot, lambda: push_along(arm, slot, push), push.start, push.end)


def draw_push_start(rng: np.random.Generator, points: Array, lowest: float, near_miss: bool) -> tuple[Array, Array]:
    """Draw the TCP position (3,) at the start of a push of an object, and the direction (3,) of the push.

    Args:
        rng: random generator.
        points: (P, 3) surface points of the object, m.
        lowest: lowest height of the TCP, m.
        near_miss: whether the tool passes the middle of the object at a distance.
    """
    center, angle = points.mean(axis=0), rng.uniform(-np.pi, np.pi)
    direction = np.array([np.cos(angle), np.sin(angle), 0.0])
    low = max(lowest, points[:, 2].min())
    height = rng.uniform(low, max(low, points[:, 2].max() - BELOW_TOP))
    behind = -float(((points - center) @ direction).min())
    tool = np.array([*center[:2], height]) - (behind + STAND_OFF + TOOL_RADIUS) * direction
    if near_miss:
        tool += rng.choice((-1, 1)) * rng.uniform(*PUSH_SHIFT) * np.array([-direction[1], direction[0], 0.0])
    return tool, direction


def _release(arm: Arm, rng: np.random.Generator, near_miss: bool) -> Candidate:
    drops = sample_drop_poses(arm, arm.target, arm.scene.arm_base_in_world)
    if near_miss:
        angles = rng.uniform(-np.pi, np.pi, len(drops))
        shifts = rng.uniform(*DROP_SHIFT, len(drops))
        drops[:, :2, 3] += shifts[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
    pose = _prefer_reachable(arm, rng, drops, drops)[0]
    source: Source = "near_miss" if near_miss else "random"
    return Candidate(source, "release", arm.target, lambda: carry_and_release(arm, arm.target, drops=pose[None]), pose)


def _pull(arm: Arm, rng: np.random.Generator, near_miss: bool) -> Candidate:
    part, offset = MovingPart.from_task(arm), np.eye(4)
    offset[:3, 3] = rng.normal(scale=PULL_SHIFT, size=3)
    if near_miss:
        error = rng.normal(size=3)
        offset[:3, 3] = rng.uniform(*PULL_ERROR) * error / np.linalg.norm(error)
    shifted = MovingPart(part.furniture, part.handle, part.joint, offset)
    part_in_world = part.poses_in_world(arm, np.array([part.joint_position(arm)]))[0]
    start = inverse(arm.scene.arm_base_in_world) @ part_in_world @ shifted.grasp_in_part
    source: Source = "near_miss" if near_miss else "random"
    return Candidate(source, "pull", -1, lambda: pull_handle(arm, shifted), start)
