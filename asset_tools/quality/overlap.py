"""Compute overlaps and distances of convex hulls."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import trimesh
from scipy.spatial import ConvexHull

Array = np.ndarray


@dataclass(frozen=True)
class ConvexBody:
    """A convex body, given by its corners and face normals.

    Attributes:
        points: (V, 3) corners, m.
        normals: (N, 3) outward unit normals of the faces.
    """

    points: Array
    normals: Array

    @cached_property
    def lower_corner(self) -> Array:
        """Lower corner (3,) of the bounding box, m."""
        return self.points.min(axis=0)

    @cached_property
    def upper_corner(self) -> Array:
        """Upper corner (3,) of the bounding box, m."""
        return self.points.max(axis=0)

    def transform(self, pose: Array) -> ConvexBody:
        """Return a copy of the body, transformed by a rigid motion (4, 4)."""
        return ConvexBody(self.points @ pose[:3, :3].T + pose[:3, 3], self.normals @ pose[:3, :3].T)


def make_convex_body(points: Array) -> ConvexBody:
    """Return the convex hull of points (P, 3), m, as a body."""
    hull = ConvexHull(points)
    return ConvexBody(points[hull.vertices], np.unique(np.round(hull.equations[:, :3], 6), axis=0))


def compute_overlap(moving: ConvexBody, other: ConvexBody, gap: float = 0.0) -> tuple[float, Array | None]:
    """Find the plane at which ``moving`` must be cut so that it keeps a gap to ``other``.

    The function tries the normals of all faces and returns the plane with the smallest depth. Other directions are not
    tried, so the depth is an upper bound for bodies other than boxes.

    Args:
        moving: body that is cut.
        other: body that stays.
        gap: distance to keep, m.

    Returns:
        The depth in m that is cut off, and the plane (4,): unit normal and offset. If the bodies already keep the gap,
        0 and None.
    """
    if (moving.lower_corner > other.upper_corner + gap).any() or (other.lower_corner > moving.upper_corner + gap).any():
        return 0.0, None
    normals = np.concatenate([moving.normals, -other.normals])
    edges = (other.points @ normals.T).min(axis=0) - gap
    depths = (moving.points @ normals.T).max(axis=0) - edges
    best = int(depths.argmin())
    if depths[best] <= 1e-6:
        return 0.0, None
    return float(depths[best]), np.append(normals[best], -edges[best])


def compute_max_overlap(bodies: Sequence[ConvexBody], others: Sequence[ConvexBody]) -> float:
    """Return the largest overlap in m of one of ``bodies`` with one of ``others``.

    The result is 0 if no bodies overlap.
    """
    return max((compute_overlap(body, other)[0] for body in bodies for other in others), default=0.0)


def compute_distances(pieces: Sequence[Array], points: Array) -> Array:
    """Return the distance (P,) in m of each point from the nearest convex hull.

    The distance is 0 inside a hull, and infinite without hulls.

    Args:
        pieces: corners (V, 3) of each hull, m.
        points: (P, 3) points, m.
    """
    nearest = np.full(len(points), np.inf)
    for piece in pieces:
        hull = ConvexHull(piece)
        outside = (points @ hull.equations[:, :3].T + hull.equations[:, 3]).max(axis=1) > 0
        triangles = piece[hull.simplices]
        for index in np.flatnonzero(outside):
            spots = trimesh.triangles.closest_point(triangles, np.tile(points[index], (len(triangles), 1)))
            nearest[index] = min(nearest[index], float(np.linalg.norm(spots - points[index], axis=1).min()))
        nearest[~outside] = 0.0
    return nearest
