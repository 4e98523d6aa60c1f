"""Room for moving parts: where their hulls cut into the rest of the furniture they are trimmed, so nothing sticks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from robocas_ms3.assets.kinematics import joint_motion
from robocas_ms3.assets.manifest import Joint

Array = np.ndarray

GAP = 0.0015  # m between a moving part and the rest
DEEPEST = 0.03  # m that may be cut off
LEAST = 0.2  # share of a piece that must be left
# Shares of a hinge's range; what is passed between two of them is taken for the hull of both
STOPS = (0.0, 0.005, 0.01, 0.02, 0.03, 0.05, 0.075, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)


@dataclass(frozen=True)
class _Convex:
    points: Array  # (V, 3) corners
    normals: Array  # (N, 3) of its faces, outward

    @cached_property
    def low(self) -> Array:
        return self.points.min(axis=0)

    @cached_property
    def high(self) -> Array:
        return self.points.max(axis=0)


def trimmed(pieces: Sequence[Array], others: Sequence[Array], joint: Joint) -> list[Array]:
    """Pieces of a moving part, trimmed so as to pass the rest of the furniture all the way.

    Each is cut by the plane that takes off least. Where that would be more than 3 cm, or most of the piece, it is left.

    Args:
        pieces: (V, 3) corners of each hull, m, joint closed.
        others: the same of all that stays where it is.
        joint: of the part; its far limit is where it is open.
    """
    stops = STOPS if joint.kind == "revolute" else (0.0, 1.0)  # what slides past is convex all the way
    passed = [_passed(other, joint, span) for span in pairwise(stops) for other in others]
    found = []
    for piece in pieces:
        convex, volume = _convex(piece), ConvexHull(piece).volume
        for other in passed:
            depth, plane = _overlap(convex, other)
            if plane is None or depth > DEEPEST:
                continue
            cut = _below(convex.points, plane)
            if cut is not None and ConvexHull(cut).volume >= LEAST * volume:
                convex = _convex(cut)
        found.append(convex.points)
    return found


def overlaps(pieces: Sequence[Array], others: Sequence[Array], joint: Joint, share: float) -> Array:
    """Depths in m by which pieces (rows) of a moving part reach into others (columns); 0 where they don't touch.

    Args:
        pieces: as in `trimmed`.
        others: as in `trimmed`.
        joint: of the part.
        share: of its range at which it stands.
    """
    rest = [_passed(other, joint, (share, share)) for other in others]
    depths = [[_overlap(_convex(piece), other)[0] - GAP for other in rest] for piece in pieces]
    return np.maximum(np.array(depths).reshape(len(pieces), len(rest)), 0.0)


def _convex(points: Array) -> _Convex:
    hull = ConvexHull(points)
    corners = points[hull.vertices]
    return _Convex(corners, np.unique(np.round(hull.equations[:, :3], 6), axis=0))


def _passed(other: Array, joint: Joint, span: tuple[float, float]) -> _Convex:
    """Where something that stays is while a joint moves, as its link sees it."""
    far = max(joint.limits, key=abs)
    places = []
    for share in dict.fromkeys(span):
        motion = joint_motion(joint, share * far)
        places.append((other - motion[:3, 3]) @ motion[:3, :3])
    return _convex(np.concatenate(places))


def _overlap(moving: _Convex, other: _Convex) -> tuple[float, Array | None]:
    """How much must come off a moving piece, m, and the plane (4,) to cut it at; 0 and none if there is room enough.

    Directions are those of the faces of both.
    """
    if (moving.low > other.high + GAP).any() or (other.low > moving.high + GAP).any():
        return 0.0, None
    normals = np.concatenate([moving.normals, -other.normals])
    edges = (other.points @ normals.T).min(axis=0) - GAP
    depths = (moving.points @ normals.T).max(axis=0) - edges
    best = int(depths.argmin())
    if depths[best] <= 1e-6:
        return 0.0, None
    return float(depths[best]), np.append(normals[best], -edges[best])


def _below(points: Array, plane: Array) -> Array | None:
    """Corners of what is left of a hull below a plane; none: too little."""
    heights = points @ plane[:3] + plane[3]
    corners = ConvexHull(points).simplices
    edges = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    edges = edges[(heights[edges[:, 0]] < 0) & (heights[edges[:, 1]] > 0)]
    first, second = points[edges[:, 0]], points[edges[:, 1]]
    low, high = heights[edges[:, 0]], heights[edges[:, 1]]
    crossings = first + (second - first) * (-low / (high - low))[:, None]
    left = np.concatenate([points[heights <= 0], crossings])
    try:
        return left[ConvexHull(left).vertices]
    except (QhullError, ValueError):
        return None
