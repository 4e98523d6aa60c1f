"""Check annotated grasps (TCP poses) for direction and collisions of the open gripper."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.assets.annotations import GRIPPER_BOXES
from robocas_ms3.assets.pack import LoadedObject

Array = NDArray[np.float64]

Approach = Literal["top", "front"]  # from above; horizontal, as into a shelf

MAX_WIDTH = float(2 * GRIPPER_BOXES[0, 0, 1])  # m, opening of the gripper for which grasps are annotated
MAX_CLOSING_TILT_DEG = 60.0  # of the closing axis from the horizontal
MAX_SIDEWAYS_DEG = 45.0  # of the approach's horizontal direction from that of base -> object
FRONT_ELEVATION_DEG = (-60.0, 10.0)  # of a front approach above the horizontal
FREE_LEAN_DEG = 15.0  # an approach this close to vertical has no meaningful horizontal direction
PREGRASP_DISTANCE = 0.1  # m

SIDE_CLEARANCE = 0.005  # m of free space on either side of the gripper, since planners inflate obstacles
NEIGHBOURHOOD = 0.5  # m from an object's centre, beyond which the gripper at one of its grasps does not reach
SPARSE = 16  # every 16th point is tested first, then all points
TESTED_AT_ONCE = 1 << 16  # pairs of grasp and point
HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])  # half a turn about the approach axis gives an equivalent grasp


def grasp_direction_tests(
    tcp_in_world: Array, base_to_object: Array, approach: Approach = "top"
) -> dict[str, NDArray[np.bool_]]:
    """Test the approach direction and the closing direction of G grasps.

    Args:
        tcp_in_world: (G, 4, 4) TCP poses of the grasps.
        base_to_object: (2,) or (3,) vector from the arm's base to the object in the world; z is ignored. The approach
            may deviate from its direction by at most `MAX_SIDEWAYS_DEG`, unless it is nearly vertical
            (`FREE_LEAN_DEG`).
        approach: allowed approach: ``top`` from above, ``front`` horizontal.

    Returns:
        Three tests by name, each (G,) bool: ``from_above`` or ``from_the_front``; ``from_the_robots_side``;
        ``closing_is_level``.
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


def is_gripper_clear(tcp_in_world: Array, points_in_world: Array, side_clearance: float = 0.0) -> NDArray[np.bool_]:
    """Return for each grasp (G,) whether the open gripper reaches it without touching a point.

    The gripper moves on a straight line from the pre-grasp to the grasp.

    Args:
        tcp_in_world: (G, 4, 4) TCP poses of the grasps.
        points_in_world: (P, 3) points on obstacles, m.
        side_clearance: least distance of the points from the sides of the gripper (along x and y of the TCP), m.
    """
    clear = np.ones(len(tcp_in_world), dtype=bool)
    if len(points_in_world) == 0 or len(tcp_in_world) == 0:
        return clear
    low, high = _make_swept_boxes(side_clearance)
    first, last = _bounds_around(tcp_in_world, low.min(axis=0), high.max(axis=0))
    columns = _select_inside(points_in_world, first.min(axis=0), last.max(axis=0)).T
    if columns.size == 0:
        return clear
    left = np.flatnonzero(np.all((first <= columns.max(axis=1)) & (last >= columns.min(axis=1)), axis=1))
    for points in (columns[:, ::SPARSE].T, columns.T):  # a few points exclude most of the blocked grasps
        batch = max(1, TESTED_AT_ONCE // len(points))
        for start in range(0, len(left), batch):
            part = left[start : start + batch]
            clear[part] = ~_any_inside(tcp_in_world[part], points, low, high)
        left = left[clear[left]]
    return clear


def select_near_points(tcp_in_world: Array, points_in_world: Array, side_clearance: float = 0.0) -> Array:
    """Return the points (Q, 3) that may touch the open gripper at one of the grasps; see `is_gripper_clear`.

    Call it before `is_gripper_clear` if that tests many points for a few grasps at a time.
    """
    if len(tcp_in_world) == 0:
        return points_in_world[:0]
    low, high = _make_swept_boxes(side_clearance)
    first, last = _bounds_around(tcp_in_world, low.min(axis=0), high.max(axis=0))
    return _select_inside(points_in_world, first.min(axis=0), last.max(axis=0))


def _make_swept_boxes(side_clearance: float) -> tuple[Array, Array]:
    """Return the corners (B, 3) of boxes around the gripper between pre-grasp and grasp, in the TCP frame."""
    low, high = GRIPPER_BOXES[:, 0].copy(), GRIPPER_BOXES[:, 1].copy()
    low -= (side_clearance, side_clearance, PREGRASP_DISTANCE)
    high += (side_clearance, side_clearance, 0.0)
    return low, high


def _bounds_around(tcp_in_world: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """Return bounds (G, 3) in the world of a box in each TCP frame and its mirror image at y = 0."""
    low = np.array([low[0], -high[1], low[2]])
    rotations = tcp_in_world[:, :3, :3]
    centers = rotations @ ((low + high) / 2) + tcp_in_world[:, :3, 3]
    extents = np.abs(rotations) @ ((high - low) / 2) + 1e-9
    return centers - extents, centers + extents


def _any_inside(tcp: Array, points: Array, low: Array, high: Array) -> NDArray[np.bool_]:
    """Return for each TCP (G,) whether any point (P, 3) is inside one of B boxes in its frame.

    Each box has a mirror image at y = 0, which counts, too.
    """
    x, y, z = to_tcp_frames(tcp, points)
    y = np.abs(y)
    inside = np.zeros(len(tcp), dtype=bool)
    for low_corner, high_corner in zip(low, high, strict=True):
        inside |= _is_inside((x, y, z), low_corner, high_corner).any(axis=1)
    return inside


def _select_inside(points: Array, low: Array, high: Array) -> Array:
    """Return the points (P, 3) inside a box as (Q, 3); each of its columns is contiguous, which makes tests fast."""
    inside = _is_inside(points.T, low, high)
    return np.stack([column[inside] for column in points.T]).T


def _is_inside(columns: Iterable[Array], low: Array, high: Array) -> NDArray[np.bool_]:
    """Return whether points are inside a box: their x, y and z of any shape, and the corners (3,) of the box."""
    tests = [(values >= least) & (values <= most) for values, least, most in zip(columns, low, high, strict=True)]
    return np.logical_and.reduce(tests)


def to_tcp_frames(tcp: Array, points: Array) -> Iterator[Array]:
    """Yield x, then y, then z (G, P) of points (P, 3) in the frames of TCP poses (G, 4, 4)."""
    # without BLAS, whose threads may change the last bits
    a, b, c = (points[:, i] - tcp[:, i, 3, None] for i in range(3))
    for axis in range(3):
        yield tcp[:, 0, axis, None] * a + tcp[:, 1, axis, None] * b + tcp[:, 2, axis, None] * c


def has_free_grasps(
    asset: LoadedObject,
    object_in_world: Array,
    scene_points_in_world: Array,
    robot_xy: Array,
    approach: Approach = "top",
    *,
    min_count: int,
) -> bool:
    """Return whether an object has ``min_count`` collision-free grasps with an allowed direction.

    Args:
        asset: the object.
        object_in_world: (4, 4) pose of the object.
        scene_points_in_world: (P, 3) points on all other surfaces of the scene, m.
        robot_xy: (2,) position of the arm's base in the world, m.
        approach: allowed approach: ``top`` from above, ``front`` horizontal.
        min_count: least number of such grasps.
    """
    notes, center = asset.annotations, object_in_world[:3, 3]
    grasps = object_in_world @ notes.grasps_tcp_in_object
    good = notes.grasp_widths <= MAX_WIDTH
    for passed in grasp_direction_tests(grasps, center[:2] - robot_xy, approach).values():
        good &= passed
    grasps = grasps[good]
    if min_count == 0 or len(grasps) < min_count:
        return min_count == 0
    near = select_near_points(grasps, scene_points_in_world, SIDE_CLEARANCE)
    free, batch = 0, 2 * min_count  # the first batch usually decides
    for start in range(0, len(grasps), batch):
        if free >= min_count or free + len(grasps) - start < min_count:
            break
        free += int(is_gripper_clear(grasps[start : start + batch], near, side_clearance=SIDE_CLEARANCE).sum())
    return free >= min_count
