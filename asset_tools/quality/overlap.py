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
    """A convex body.

    Attributes:
        points: (V, 3) corners, m.
        normals: (N, 3) outward normals of its faces.
    """

    points: Array
    normals: Array

    @cached_property
    def low(self) -> Array:
        """Lower corner (3,) of the bounding box."""
        return self.points.min(axis=0)

    @cached_property
    def high(self) -> Array:
        """Upper corner (3,) of the bounding box."""
        return self.points.max(axis=0)

    def moved(self, pose: Array) -> ConvexBody:
        """Return the body transformed by a rigid motion (4, 4)."""
        return ConvexBody(self.points @ pose[:3, :3].T + pose[:3, 3], self.normals @ pose[:3, :3].T)


def make_convex_body(points: Array) -> ConvexBody:
    """Return the convex hull of points (V, 3)."""
    hull = ConvexHull(points)
    return ConvexBody(points[hull.vertices], np.unique(np.round(hull.equations[:, :3], 6), axis=0))


def overlap(moving: ConvexBody, other: ConvexBody, gap: float = 0.0) -> tuple[float, Array | None]:
    """Return the depth in m of the cut that leaves a gap between two bodies, and its plane (4,); or 0 and None.

    Only directions of face normals are tried, so for bodies other than boxes the depth is an upper bound.
    """
    if (moving.low > other.high + gap).any() or (other.low > moving.high + gap).any():
        return 0.0, None
    normals = np.concatenate([moving.normals, -other.normals])
    edges = (other.points @ normals.T).min(axis=0) - gap
    depths = (moving.points @ normals.T).max(axis=0) - edges
    best = int(depths.argmin())
    if depths[best] <= 1e-6:
        return 0.0, None
    return float(depths[best]), np.append(normals[best], -edges[best])


def max_overlap(bodies: Sequence[ConvexBody], others: Sequence[ConvexBody]) -> float:
    """Return the largest overlap in m of any of ``bodies`` with any of ``others``; 0 without contact."""
    return max((overlap(body, other)[0] for body in bodies for other in others), default=0.0)


def distances(pieces: Sequence[Array], points: Array) -> Array:
    """Return distances (P,) in m of points (P, 3) from the nearest hull (V, 3); 0 inside, infinite without hulls."""
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
