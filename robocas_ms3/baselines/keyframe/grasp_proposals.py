"""Propose grasps of an object from the points on its visible surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.poses import Array, from_rotation
from robocas_ms3.scenes.grasp_checks import GRIPPER_BOXES, HALF_TURN, is_gripper_clear

MIN_POINTS = 15
"""Least number of points on an object."""
_MAX_POINTS = 400  # points on the object that are used
_SLICE = 0.012  # m from the closing plane, within which points are between the fingers
_MIN_SLICE_POINTS = 4
_MAX_WIDTH = 0.072  # m between the fingers, of an opening of 0.08
_DEPTHS = (0.012, 0.045)  # m from the highest point between the fingers to the TCP
_TIP = 0.0085  # m from the TCP to the end of the fingers
_TABLE_CLEARANCE = 0.004  # m between the fingers and the surface
_TOP_TILTS, _FRONT_TILTS = np.deg2rad((0, 50)), np.deg2rad((35, 95))  # of the approach from the vertical
_FRONT_ROLL = 0.3  # rad, standard deviation of the closing direction from the horizontal, for grasps from the front
_ANY_DIRECTION = np.deg2rad(15)  # tilt below which the approach may come from any side
_VERTICAL_FRACTION, _INNER_FRACTION = 0.35, 0.6  # fractions of vertical approaches, and of grasps near the middle
_NEIGHBOURHOOD = 0.3  # m from the middle of the object, beyond which other points are ignored
_SIDE_CLEARANCE = 0.002  # m beside the gripper
_SIMILAR_DISTANCE, _SIMILAR_ANGLE = 0.02, np.deg2rad(37)  # m and rad between similar grasps


@dataclass(frozen=True)
class Proposals:
    """G grasps of an object.

    Attributes:
        tcp_in_base: (G, 4, 4) TCP poses in the arm's base frame.
        heuristic: (G,) heuristic score: greater for vertical grasps near the middle of the object.
    """

    tcp_in_base: Array
    heuristic: Array

    def select(self, rows: NDArray) -> Proposals:
        """Return the grasps of some rows."""
        return Proposals(self.tcp_in_base[rows], self.heuristic[rows])


def propose_grasps(
    points: Array,
    is_object: NDArray[np.bool_],
    table: float,
    count: int,
    rng: np.random.Generator,
    *,
    from_front: bool = False,
) -> Proposals:
    """Propose up to ``count`` grasps of an object whose open gripper touches no other point.

    Args:
        points: (P, 3) points in the arm's base frame, m.
        is_object: (P,) whether each point is on the object.
        table: height of the surface in the arm's base frame, m.
        count: number of grasps before the checks.
        rng: random generator.
        from_front: whether the gripper approaches from the front instead of from above.
    """
    proposals = propose_colliding_grasps(points[is_object], table, count, rng, from_front=from_front)
    if not len(proposals.heuristic):
        return proposals
    middle = points[is_object].mean(axis=0)
    others = points[~is_object & (points[:, 2] > table + _TABLE_CLEARANCE)]
    near = others[np.linalg.norm(others - middle, axis=1) < _NEIGHBOURHOOD]
    clear = is_gripper_clear(proposals.tcp_in_base, near, _SIDE_CLEARANCE)
    return proposals.select(clear & _is_above(proposals.tcp_in_base, table))


def propose_colliding_grasps(
    points: Array, table: float, count: int, rng: np.random.Generator, *, from_front: bool = False
) -> Proposals:
    """Propose up to ``count`` grasps of an object with points (P, 3); other objects are ignored."""
    none = Proposals(np.zeros((0, 4, 4)), np.zeros(0))
    if len(points) < MIN_POINTS:
        return none
    middle = points.mean(axis=0)
    if len(points) > _MAX_POINTS:
        points = points[rng.choice(len(points), _MAX_POINTS, replace=False)]
    starts = points[rng.integers(len(points), size=count)]
    inner = rng.random(count) < _INNER_FRACTION
    starts[inner] = 0.6 * starts[inner] + 0.4 * middle
    rotations, tilt = _draw_rotations(starts, rng, from_front=from_front)
    local = np.einsum("gpi,gij->gpj", points[None] - starts[:, None], rotations)
    between = np.abs(local[..., 0]) < _SLICE
    fits = between.sum(axis=1) >= _MIN_SLICE_POINTS
    top = np.where(fits, np.where(between, local[..., 2], np.inf).min(axis=1), 0.0)
    depth = top + rng.uniform(*_DEPTHS, count)
    approach = rotations[:, :, 2]
    tip = starts[:, 2] + approach[:, 2] * (depth + _TIP)
    depth -= np.maximum(table + _TABLE_CLEARANCE - tip, 0) / np.maximum(-approach[:, 2], 0.3)
    between &= local[..., 2] < (depth + _SLICE)[:, None]
    left = np.where(between, local[..., 1], np.inf).min(axis=1)
    right = np.where(between, local[..., 1], -np.inf).max(axis=1)
    fits &= (between.sum(axis=1) >= _MIN_SLICE_POINTS) & (right - left <= _MAX_WIDTH)
    if not fits.any():
        return none
    starts, rotations, tilt, depth, top = starts[fits], rotations[fits], tilt[fits], depth[fits], top[fits]
    left, right = left[fits], right[fits]
    shift = np.stack([np.zeros(len(depth)), (left + right) / 2, depth], axis=1)
    positions = starts + np.einsum("gij,gj->gi", rotations, shift)
    along = ((middle - positions) * rotations[:, :, 0]).sum(axis=1)
    heuristic = -20 * np.abs(along) - 8 * np.abs(depth - top - 0.03) - 4 * (right - left)
    if not from_front:
        heuristic -= 0.8 * tilt
    return Proposals(from_rotation(positions, rotations), heuristic)


def compute_similarity(grasps: Array, other: Array) -> Array:
    """Return the similarity (G,) of grasps (G, 4, 4) to another grasp (4, 4).

    It is 1 for equal grasps, also after half a turn of the gripper, decreases with the distance, and is 0 if the
    rotations differ by more than `_SIMILAR_ANGLE`.
    """
    rotations = np.stack([other[:3, :3], (other @ HALF_TURN)[:3, :3]])
    traces = np.einsum("gij,kij->gk", grasps[:, :3, :3], rotations).max(axis=1)
    distances = np.linalg.norm(grasps[:, :3, 3] - other[:3, 3], axis=1)
    return np.exp(-((distances / _SIMILAR_DISTANCE) ** 2)) * (traces > 1 + 2 * np.cos(_SIMILAR_ANGLE))


def _is_above(tcp_in_base: Array, table: float) -> NDArray[np.bool_]:
    """Return for each grasp (G, 4, 4) whether the whole gripper is above a surface."""
    corners = np.stack(np.meshgrid(*[(0, 1)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    points = np.concatenate([box[corners, range(3)] for box in GRIPPER_BOXES])
    points = np.concatenate([points, points * (1, -1, 1)])  # the boxes are one half of the gripper
    heights = tcp_in_base[:, 2, 3][:, None] + tcp_in_base[:, 2, :3] @ points.T
    return np.asarray(heights.min(axis=1) > table)


def _draw_rotations(starts: Array, rng: np.random.Generator, *, from_front: bool) -> tuple[Array, Array]:
    """Draw rotations (G, 3, 3) of the TCP in the arm's base frame; return them and the tilts (G,) of the approach."""
    count = len(starts)
    vertical = 0.0 if from_front else _VERTICAL_FRACTION
    tilts = _FRONT_TILTS if from_front else _TOP_TILTS
    tilt = np.where(rng.random(count) < vertical, 0.0, rng.uniform(tilts[0], tilts[1], count))
    outward = np.arctan2(starts[:, 1], starts[:, 0]) + rng.uniform(-np.pi / 4, np.pi / 4, count)
    azimuth = np.where(tilt < _ANY_DIRECTION, rng.uniform(-np.pi, np.pi, count), outward)
    approach = np.stack([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), -np.cos(tilt)], axis=1)
    turn = rng.uniform(-np.pi, np.pi, count)
    if from_front:
        turn = azimuth + np.pi / 2 + rng.normal(0, _FRONT_ROLL, count)
    closing = np.stack([np.cos(turn), np.sin(turn), np.zeros(count)], axis=1)
    closing -= approach * (approach * closing).sum(axis=1, keepdims=True)
    closing /= np.linalg.norm(closing, axis=1, keepdims=True)
    return np.stack([np.cross(closing, approach), closing, approach], axis=2), tilt
