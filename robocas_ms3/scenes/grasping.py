"""Which annotated grasps to try, and in what order: geometry only, no simulator.

A grasp is a pose of the TCP: z approach, y closing direction. Turned by 180 deg about its approach it is the same grasp
with another turn of the wrist, so both are candidates.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.assets.gripper import GRIPPER_BOXES
from robocas_ms3.assets.pack import LoadedObject

Array = NDArray[np.float64]

Approach = Literal["top", "front"]  # from above; level, as into a shelf

MAX_WIDTH = 0.08  # m, the gripper's opening
MAX_CLOSING_TILT_DEG = 60.0  # of the closing axis from the horizontal
MAX_SIDEWAYS_DEG = 45.0  # of the approach's horizontal direction from that of base -> object
FRONT_ELEVATION_DEG = (-60.0, 10.0)  # of a front approach above the horizontal
FREE_LEAN_DEG = 15.0  # an approach this close to straight down has no horizontal direction to speak of
PREGRASP_DISTANCE = 0.1  # m

# m to either side that a free grasp leaves: planners take what stands around for larger than it is.
SIDE_CLEARANCE = 0.005
NEIGHBOURHOOD = 0.5  # m from an object's centre, beyond which the gripper at one of its grasps does not reach

# What lies between the pads, in the TCP's frame, and how a robot may miss: across the pads, and not deep enough, m
PAD_HALF_WIDTH, PAD_BEHIND_TCP, PAD_BEFORE_TCP = 0.009, -0.012, 0.008
GRIP_SHIFTS = ((0.0, 0.0), (0.006, 0.0), (-0.006, 0.0), (0.0, -0.006), (0.004, -0.004), (-0.004, -0.004))
PAD_POINTS = 10  # of a surface at 5 mm: a third of what fits
ROOM_BESIDE = 0.006  # m between an object and each open finger
MARGIN_WEIGHT = 1.0
TURN_WEIGHT = 0.4  # a rad

SPARSE = 16  # every so manieth point is tested against the gripper before all of them
TESTED_AT_ONCE = 1 << 16  # pairs of grasp and point

HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])  # of the wrist, about the approach


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


def directions_ok(
    tcp_in_world: Array, base_to_object: Array, approach: Approach = "top"
) -> dict[str, NDArray[np.bool_]]:
    """Test the directions of grasps against gravity and the robot.

    The robot reaches an object from its own side: the approach's horizontal part may deviate at most 45 deg from the
    horizontal direction base -> object. From above, approaches within 15 deg of straight down pass, since they come
    from no side. From the front, the approach points at most 60 deg down and at most 10 deg up.

    Args:
        tcp_in_world: (G, 4, 4).
        base_to_object: (3,) or (2,) in the world; only the horizontal part counts.
        approach: from where the gripper may come.

    Returns:
        Three tests, each (G,): ``from_above`` or ``from_the_front``, ``from_the_robots_side``, ``closing_is_level``.
    """
    axis, closing = tcp_in_world[:, :3, 2], tcp_in_world[:, :3, 1]
    lean = np.linalg.norm(axis[:, :2], axis=1)  # sine of the angle from the vertical
    forward = base_to_object[:2] / max(np.linalg.norm(base_to_object[:2]), 1e-9)
    along = axis[:, :2] @ forward
    from_side = along >= lean * np.cos(np.deg2rad(MAX_SIDEWAYS_DEG)) - 1e-9
    if approach == "top":
        tests = {"from_above": axis[:, 2] < 0}
        from_side |= lean <= np.sin(np.deg2rad(FREE_LEAN_DEG))
    else:
        lowest, highest = np.sin(np.deg2rad(FRONT_ELEVATION_DEG))
        tests = {"from_the_front": (axis[:, 2] >= lowest - 1e-9) & (axis[:, 2] <= highest + 1e-9)}
    closing_is_level = np.abs(closing[:, 2]) <= np.sin(np.deg2rad(MAX_CLOSING_TILT_DEG)) + 1e-9
    return tests | {"from_the_robots_side": from_side, "closing_is_level": closing_is_level}


def gripper_is_clear(
    tcp_in_world: Array, points_in_world: Array, sweep: float = PREGRASP_DISTANCE, side_clearance: float = 0.0
) -> NDArray[np.bool_]:
    """Say for each grasp (G, 4, 4) whether no point (P, 3) lies in the open gripper, from pre-grasp to grasp.

    Args:
        tcp_in_world: (G, 4, 4).
        points_in_world: (P, 3) m.
        sweep: distance from which the gripper comes in along its approach, m.
        side_clearance: how far from its sides (along x and y of the TCP) points have to stay, m.
    """
    clear = np.ones(len(tcp_in_world), dtype=bool)
    if len(points_in_world) == 0 or len(tcp_in_world) == 0:
        return clear
    low, high = GRIPPER_BOXES[:, 0].copy(), GRIPPER_BOXES[:, 1].copy()
    low -= (side_clearance, side_clearance, sweep)
    high += (side_clearance, side_clearance, 0.0)
    first, last = _bounds_around(tcp_in_world, low.min(axis=0), high.max(axis=0))
    near = np.all((points_in_world >= first.min(0)) & (points_in_world <= last.max(0)), axis=1)
    points = points_in_world[near]
    if len(points) == 0:
        return clear
    left = np.flatnonzero(np.all((first <= points.max(0)) & (last >= points.min(0)), axis=1))
    for some in (points[::SPARSE], points):  # few points tell of most of the grasps that are not clear
        batch = max(1, TESTED_AT_ONCE // len(some))
        for start in range(0, len(left), batch):
            part = left[start : start + batch]
            clear[part] = ~_any_inside(tcp_in_world[part], some, low, high)
        left = left[clear[left]]
    return clear


def _bounds_around(tcp_in_world: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """Low and high corners (G, 3) of what is between ``low`` and ``high`` (3,) and, mirrored at y = 0, at each TCP."""
    low = np.array([low[0], -high[1], low[2]])
    rotations = tcp_in_world[:, :3, :3]
    centers = rotations @ ((low + high) / 2) + tcp_in_world[:, :3, 3]
    extents = np.abs(rotations) @ ((high - low) / 2) + 1e-9
    return centers - extents, centers + extents


def _any_inside(tcp: Array, points: Array, low: Array, high: Array) -> NDArray[np.bool_]:
    """Say for each TCP (G, 4, 4) whether a point (P, 3) is in one of the boxes (B, 3), or in their mirror image."""
    x, y, z = _seen_from(tcp, points)
    y = np.abs(y)
    inside = np.zeros(len(tcp), dtype=bool)
    for (x0, y0, z0), (x1, y1, z1) in zip(low, high, strict=True):
        inside |= ((x >= x0) & (x <= x1) & (y <= y1) & (y >= y0) & (z >= z0) & (z <= z1)).any(axis=1)
    return inside


def _seen_from(tcp: Array, points: Array) -> Iterator[Array]:
    """Coordinates x, y, z, (G, P) each, of points (P, 3) in the frames of TCPs (G, 4, 4).

    No BLAS, whose threads may change the last bits.
    """
    a, b, c = (points[:, i] - tcp[:, i, 3, None] for i in range(3))
    for axis in range(3):
        yield tcp[:, 0, axis, None] * a + tcp[:, 1, axis, None] * b + tcp[:, 2, axis, None] * c


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
        x, y, z = _seen_from(tcp[start : start + batch], surface)
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


def has_free_grasps(
    asset: LoadedObject,
    object_in_world: Array,
    scene_points_in_world: Array,
    robot_xy: Array,
    approach: Approach = "top",
    *,
    at_least: int,
) -> bool:
    """Say whether enough of an object's grasps come from the robot's side and pass clear of everything else.

    Args:
        asset: the object.
        object_in_world: 4x4.
        scene_points_in_world: (P, 3) surfaces of everything else.
        robot_xy: (2,) where the arm's base stands, m.
        approach: from where the gripper may come.
        at_least: how many are enough.
    """
    notes, center = asset.annotations, object_in_world[:3, 3]
    grasps = object_in_world @ notes.grasps_tcp_in_object
    good = notes.grasp_widths <= MAX_WIDTH
    for passed in directions_ok(grasps, center[:2] - robot_xy, approach).values():
        good &= passed
    grasps = grasps[good]
    if at_least == 0 or len(grasps) < at_least:
        return at_least == 0
    low, high = _swept_bounds(grasps)
    near = scene_points_in_world[np.all((scene_points_in_world >= low) & (scene_points_in_world <= high), axis=1)]
    free, batch = 0, 2 * at_least  # mostly the first batch decides
    for start in range(0, len(grasps), batch):
        if free >= at_least or free + len(grasps) - start < at_least:
            break
        free += int(gripper_is_clear(grasps[start : start + batch], near, side_clearance=SIDE_CLEARANCE).sum())
    return free >= at_least


def _swept_bounds(tcp_in_world: Array) -> tuple[Array, Array]:
    """Low and high corner (3,) of all that the open gripper passes on its way to grasps (G, 4, 4)."""
    high = GRIPPER_BOXES[:, 1].max(axis=0) + (SIDE_CLEARANCE, SIDE_CLEARANCE, 0)
    low = np.array([-high[0], -high[1], GRIPPER_BOXES[:, 0, 2].min() - PREGRASP_DISTANCE])
    corners = np.array(list(itertools.product(*zip(low, high, strict=True))))
    points = (tcp_in_world[:, None, :3, :3] @ corners[:, :, None])[..., 0] + tcp_in_world[:, None, :3, 3]
    return points.min(axis=(0, 1)), points.max(axis=(0, 1))
