"""Trim hulls of moving parts that intersect the rest of the furniture, so that the parts can move."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from asset_tools.quality.overlap import ConvexBody, compute_overlap, make_convex_body
from robocas_ms3.assets.kinematics import joint_motion
from robocas_ms3.assets.manifest import Joint

Array = np.ndarray

GAP = 0.0015  # m between a moving part and the rest
DEEPEST = 0.03  # m, largest depth of a cut
LEAST = 0.2  # minimum remaining fraction of a piece
PASSES = 3  # a later pass may make a cut that was too deep before
# fractions of a hinge's range; the swept volume between two stops is approximated by the hull of both
STOPS = (0.0, 0.005, 0.01, 0.02, 0.03, 0.05, 0.075, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)


def trim_colliding_pieces(pieces: Sequence[Array], others: Sequence[Array], joint: Joint) -> list[Array]:
    """Cut the pieces of a moving part so that they never touch the rest of the furniture.

    A piece that would touch another hull is cut by a plane; of all possible planes, the plane with the smallest depth
    is used. A piece stays unchanged if the cut would be deeper than 3 cm, or would leave less than 20 % of the piece.

    Args:
        pieces: corners (V, 3) of each piece with the joint closed, m.
        others: corners (V, 3) of each hull that does not move, m.
        joint: joint of the part. It is closed at 0 and open at the limit that is farther from 0.

    Returns:
        Corners (V, 3) of each piece after the cuts, m.
    """
    stops = STOPS if joint.kind == "revolute" else (0.0, 1.0)  # the volume swept by sliding is convex
    passed = [_passed(other, joint, span) for span in pairwise(stops) for other in others]
    found = []
    for piece in pieces:
        body, volume = make_convex_body(piece), ConvexHull(piece).volume
        for _ in range(PASSES):
            before = body
            for other in passed:
                depth, plane = compute_overlap(body, other, GAP)
                if plane is None or depth > DEEPEST:
                    continue
                cut = _below(body.points, plane)
                if cut is not None and ConvexHull(cut).volume >= LEAST * volume:
                    body = make_convex_body(cut)
            if body is before:
                break
        found.append(body.points)
    return found


def _passed(other: Array, joint: Joint, span: tuple[float, float]) -> ConvexBody:
    """Return the volume through which a static hull moves, seen from the moving part.

    Args:
        other: corners (V, 3) of the static hull, m.
        joint: joint of the moving part.
        span: start and end of the motion, as fractions of the range of the joint.
    """
    far = max(joint.limits, key=abs)
    places = []
    for fraction in dict.fromkeys(span):
        motion = joint_motion(joint, fraction * far)
        places.append((other - motion[:3, 3]) @ motion[:3, :3])
    return make_convex_body(np.concatenate(places))


def _below(points: Array, plane: Array) -> Array | None:
    """Cut a hull by a plane.

    Return the corners (V, 3) below the plane, or None if this part has no volume.

    Args:
        points: (P, 3) corners of the hull.
        plane: (4,) normal and offset; a point x is below if ``normal @ x + offset < 0``.
    """
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
