"""Room for moving parts: where their hulls cut into the rest of the furniture they are trimmed, so nothing sticks."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from asset_tools.quality.overlap import ConvexBody, convex, overlap
from robocas_ms3.assets.kinematics import joint_motion
from robocas_ms3.assets.manifest import Joint

Array = np.ndarray

GAP = 0.0015  # m between a moving part and the rest
DEEPEST = 0.03  # m that may be cut off
LEAST = 0.2  # share of a piece that must be left
PASSES = 3  # what one cut left too deep for the next may be shallow after it
# Shares of a hinge's range; what is passed between two of them is taken for the hull of both
STOPS = (0.0, 0.005, 0.01, 0.02, 0.03, 0.05, 0.075, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)


def trim_pieces(pieces: Sequence[Array], others: Sequence[Array], joint: Joint) -> list[Array]:
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
        body, volume = convex(piece), ConvexHull(piece).volume
        for _ in range(PASSES):
            before = body
            for other in passed:
                depth, plane = overlap(body, other, GAP)
                if plane is None or depth > DEEPEST:
                    continue
                cut = _below(body.points, plane)
                if cut is not None and ConvexHull(cut).volume >= LEAST * volume:
                    body = convex(cut)
            if body is before:
                break
        found.append(body.points)
    return found


def _passed(other: Array, joint: Joint, span: tuple[float, float]) -> ConvexBody:
    """Where something that stays is while a joint moves, as its link sees it."""
    far = max(joint.limits, key=abs)
    places = []
    for share in dict.fromkeys(span):
        motion = joint_motion(joint, share * far)
        places.append((other - motion[:3, 3]) @ motion[:3, :3])
    return convex(np.concatenate(places))


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
