"""Which annotated grasps an arm should try, and in what order: geometry only, no simulator."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.scenes.grasping import (
    HALF_TURN,
    MAX_WIDTH,
    PREGRASP_DISTANCE,
    TESTED_AT_ONCE,
    Approach,
    directions_ok,
    gripper_is_clear,
    seen_from,
)

Array = NDArray[np.float64]

# What lies between the pads, in the TCP's frame, and how a robot may miss: across the pads, and not deep enough, m
PAD_HALF_WIDTH, PAD_BEHIND_TCP, PAD_BEFORE_TCP = 0.009, -0.012, 0.008
GRIP_SHIFTS = ((0.0, 0.0), (0.006, 0.0), (-0.006, 0.0), (0.0, -0.006), (0.004, -0.004), (-0.004, -0.004))
PAD_POINTS = 10  # of a surface at 5 mm: a third of what fits
ROOM_BESIDE = 0.006  # m between an object and each open finger
MARGIN_WEIGHT = 1.0
TURN_WEIGHT = 0.4  # a rad


@dataclass(frozen=True)
class GraspFilter:
    """Grasps that are left; the second half are the first half with the wrist turned by 180 deg.

    Attributes:
        tcp_in_world: (2K, 4, 4).
        widths: (2K,) m.
        qualities: (2K,).
        index: (2K,) which of the given grasps each one is.
        rejected: how many fell to each test, in the order of the tests.
    """

    tcp_in_world: Array
    widths: Array
    qualities: Array
    index: NDArray[np.int_]
    rejected: dict[str, int]

    def __len__(self) -> int:
        return len(self.index)


def filter_grasps(
    tcp_in_world: Array,
    widths: Array,
    *,
    arm_base_in_world: Array,
    object_center_in_world: Array,
    scene_points_in_world: Array,
    qualities: Array | None = None,
    sweep: float = PREGRASP_DISTANCE,
    side_clearance: float = 0.0,
    approach: Approach = "top",
) -> GraspFilter:
    """Keep the grasps that a robot standing there could try; the wrist-turned twin of each is added.

    Args:
        tcp_in_world: (G, 4, 4).
        widths: (G,) opening the object needs there, m.
        arm_base_in_world: 4x4.
        object_center_in_world: (3,).
        scene_points_in_world: (P, 3) surfaces that the open gripper may not touch, the object itself left out.
        qualities: (G,), more is better; none: all alike.
        sweep: straight way in, m.
        side_clearance: how far from the gripper's sides the points have to stay, m.
        approach: from where the gripper may come.
    """
    poses = np.asarray(tcp_in_world, dtype=np.float64).reshape(-1, 4, 4)
    widths = np.asarray(widths, dtype=np.float64)
    qualities = np.ones(len(poses)) if qualities is None else np.asarray(qualities, dtype=np.float64)
    tests = {"narrow_enough": widths <= MAX_WIDTH}
    base_to_object = np.asarray(object_center_in_world)[:3] - np.asarray(arm_base_in_world)[:3, 3]
    tests |= directions_ok(poses, base_to_object, approach)
    left, rejected = np.ones(len(poses), dtype=bool), {}
    for name, passed in tests.items():
        rejected[name] = int(np.sum(left & ~passed))
        left &= passed
    index = np.flatnonzero(left)
    clear = gripper_is_clear(poses[index], np.asarray(scene_points_in_world, dtype=np.float64), sweep, side_clearance)
    rejected["gripper_is_clear"] = int(np.sum(~clear))
    index = index[clear]
    both = np.concatenate([index, index])
    kept = np.concatenate([poses[index], poses[index] @ HALF_TURN])
    return GraspFilter(kept, widths[both], qualities[both], both, rejected)


def grip_margins(tcp: Array, widths: Array, surface: Array) -> Array:
    """How much of an object is between the pads even where a grasp comes out a little otherwise than planned.

    Args:
        tcp: (N, 4, 4) grasps, in the frame of the points.
        widths: (N,) of the object there, m.
        surface: (P, 3) of the object, m, 5 mm apart.

    Returns:
        (N,) in 0..1: 1 where at least ``PAD_POINTS`` lie between the pads of each of several shifted grasps, and
        ``ROOM_BESIDE`` beside the object while the gripper is open.
    """
    tcp = np.asarray(tcp, dtype=np.float64)
    margin = np.clip((MAX_WIDTH - np.asarray(widths)) / 2 / ROOM_BESIDE, 0, 1)
    widest, deepest = np.abs(GRIP_SHIFTS).max(axis=0)
    batch = max(1, TESTED_AT_ONCE // len(surface))
    for start in range(0, len(tcp), batch):
        x, y, z = seen_from(tcp[start : start + batch], surface)
        near = (np.abs(y) <= MAX_WIDTH / 2) & (np.abs(x) <= PAD_HALF_WIDTH + widest)
        near &= (z >= PAD_BEHIND_TCP - deepest) & (z <= PAD_BEFORE_TCP + deepest)
        grasp, _ = np.nonzero(near)
        x, z = x[near], z[near]
        some = margin[start : start + batch]
        for across, deeper in GRIP_SHIFTS:
            inside = np.abs(x - across) <= PAD_HALF_WIDTH
            inside &= (z >= PAD_BEHIND_TCP + deeper) & (z <= PAD_BEFORE_TCP + deeper)
            np.minimum(some, np.bincount(grasp[inside], minlength=len(some)) / PAD_POINTS, out=some)
    return margin


def rank_grasps(
    tcp: Array,
    qualities: Array,
    *,
    margins: Array | None = None,
    object_center: Array,
    qpos: Array,
    near: Array,
    rng: np.random.Generator,
    temperature: float = 0.15,
    approach: Approach = "top",
) -> NDArray[np.int_]:
    """Order grasps, good ones first, with some chance so that a retry tries others.

    The score adds quality (relative to the best), nearness of the TCP to the object's centre (falls by e every 3 cm),
    steepness (1 straight down, 0 level; from the front the other way round), nearness in joint space (of the joint that
    turns most, which sets the time), and the margin.

    Args:
        tcp: (N, 4, 4) in any upright frame.
        qualities: (N,), more is better.
        margins: (N,) of ``grip_margins``; default: all alike.
        object_center: (3,) in the same frame.
        qpos: (N, 7) a configuration for each.
        near: (7,) where the arm is.
        rng: source of chance.
        temperature: 0 gives the plain order; at 0.15 a grasp overtakes one that is 0.15 better about one time in four.
        approach: from where the gripper comes.

    Returns:
        (N,) indices.
    """
    tcp, qualities = np.asarray(tcp, dtype=np.float64), np.asarray(qualities, dtype=np.float64)
    if len(tcp) == 0:
        return np.zeros(0, dtype=int)
    quality = qualities / max(float(np.abs(qualities).max()), 1e-9)
    distance = np.linalg.norm(tcp[:, :3, 3] - object_center, axis=1)
    turn = np.abs(np.asarray(qpos) - near).max(axis=1)
    steep = -tcp[:, 2, 2] if approach == "top" else np.linalg.norm(tcp[:, :2, 2], axis=1)
    score = quality + np.exp(-distance / 0.03) + 0.7 * steep - TURN_WEIGHT * turn
    if margins is not None:
        score = score + MARGIN_WEIGHT * margins
    # Gumbel noise turns scores into draws without replacement, weighted by exp(score / temperature).
    return np.argsort(-(score + temperature * rng.gumbel(size=len(score))), kind="stable")
