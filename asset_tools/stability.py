"""On which sides a body can rest, by the geometry of its convex hull: how probably, how firmly."""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from robocas_ms3.core.errors import AssetError

Array = np.ndarray

LIMIT = 12  # poses of an object at most
FALLBACK = 3  # poses tried where each is improbable
SAME_DEG = 5.0  # poses whose up directions are nearer than this count as one
SAME_HEIGHT = 0.0005  # m: poses with their centre of mass this level are of one family (a cylinder on its side)
UPRIGHT_DEG = 10.0
BELOW = 0.0004  # m: how far corners of the object may reach below the plane
ROCKING_DEG = tuple(range(1, 11))  # a body rocks if, tilted by any of these, it is no lower than before


def stable_directions(hull: ConvexHull, center: Array) -> tuple[Array, Array, Array]:
    """Up directions (N, 3) of the facets the object can rest on, their probabilities and centre of mass heights.

    Each facet gets the solid angle under which it is seen from the centre of mass; where the foot of the
    perpendicular is outside of a facet, the object topples over that edge (Goldberg et al. 1999).
    """
    normals, heights = hull.equations[:, :3], -(hull.equations[:, :3] @ center + hull.equations[:, 3])
    if heights.min() <= 0:
        raise AssetError("the centre of mass is outside the hulls", found=np.round(center, 4).tolist())
    corners = hull.points[hull.simplices] - center
    a, b, c = corners.transpose(1, 0, 2)
    la, lb, lc = np.linalg.norm(corners, axis=-1).T
    volume = np.abs(np.einsum("ij,ij->i", a, np.cross(b, c)))
    below = la * lb * lc + (a * b).sum(1) * lc + (b * c).sum(1) * la + (c * a).sum(1) * lb
    shares = np.arctan2(volume, below) / (2 * np.pi)  # solid angle / 4 pi
    feet = normals * heights[:, None]
    overhang = np.empty((len(feet), 3))
    for k, (opposite, p, q) in enumerate(((a, b, c), (b, c, a), (c, a, b))):
        out = np.cross(q - p, normals)
        out *= -np.sign(np.einsum("ij,ij->i", out, opposite - p))[:, None]
        length = np.maximum(np.linalg.norm(out, axis=1), 1e-12)
        overhang[:, k] = np.einsum("ij,ij->i", out, feet - p) / length
    here = np.arange(len(feet))
    beyond = hull.neighbors[here, overhang.argmax(1)]
    # never uphill, so that rounding can't send it round in circles
    topples = (overhang.max(1) > 1e-7) & (heights[beyond] <= heights + 1e-9)
    follow = np.where(topples, beyond, here)
    for _ in range(int(np.log2(len(feet))) + 1):
        follow = follow[follow]
    pooled = np.bincount(follow, shares, len(feet))
    ends = np.flatnonzero(pooled > 0)
    return merge_poses(-normals[ends], pooled[ends] / pooled.sum(), heights[ends])


def merge_poses(directions: Array, probabilities: Array, heights: Array) -> tuple[Array, Array, Array]:
    """Unite poses of nearly the same up direction under their most probable one; the most probable first."""
    kept: list[int] = []
    sums: list[float] = []
    # rounded, so that noise does not decide between equals
    ranking: list[int] = np.argsort(-np.round(probabilities, 9), kind="stable").tolist()
    for i in ranking:
        if kept:
            cosines = directions[kept] @ directions[i]
            if cosines.max() > np.cos(np.radians(SAME_DEG)):
                sums[int(cosines.argmax())] += probabilities[i]
                continue
        kept.append(i)
        sums.append(probabilities[i])
    order = np.array(kept)[np.argsort(-np.round(sums, 9), kind="stable")]
    return directions[order], np.array(sums)[np.argsort(-np.round(sums, 9), kind="stable")], heights[order]


def select_poses(directions: Array, probabilities: Array, heights: Array, minimum: float) -> list[int]:
    """Indices of the poses to try: those of probable families, the families' heads first, then well spread.

    The upright pose is among them however improbable it is: that is how people put things down.
    """
    family = np.full(len(heights), -1)
    for i in range(len(heights)):
        if family[i] < 0:
            family[(family < 0) & (np.abs(heights - heights[i]) < SAME_HEIGHT)] = i
    shares = np.bincount(family, probabilities, len(heights))
    allowed = np.flatnonzero(shares[family] >= minimum)
    limit = LIMIT
    if not len(allowed):
        allowed, limit = np.arange(len(heights)), FALLBACK
    upright = np.flatnonzero(directions[:, 2] > np.cos(np.radians(UPRIGHT_DEG)))[:1]
    heads = np.unique(family[allowed])
    heads = heads[np.argsort(-shares[heads], kind="stable")]
    kept = [int(i) for i in dict.fromkeys([*upright, *heads])][:limit]
    while len(kept) < min(limit, len(allowed)):
        nearest = np.clip(directions[allowed] @ directions[kept].T, -1, 1).max(1)
        score = np.round(np.arccos(nearest) * probabilities[allowed], 9)
        score[np.isin(allowed, kept)] = -1
        kept.append(int(allowed[score.argmax()]))
    return kept


def pool_probabilities(directions: Array, probabilities: Array, kept: list[int]) -> Array:
    """Probabilities of the kept poses with those of all others added to the nearest."""
    nearest = (directions @ directions[kept].T).argmax(1)
    return np.bincount(nearest, probabilities, len(kept))


def rocks_in_place(points: Array, up: Array) -> bool:
    """Whether a body of corners (V, 3) about its centre of mass stays near a pose even if it leaves it.

    The sides of an oval bottle are a few facets, and on each of them it stands by a hair.
    """
    across = np.linalg.svd(up[None])[2][1:]
    turns = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    around = np.cos(turns)[:, None] * across[0] + np.sin(turns)[:, None] * across[1]
    tilts = np.radians(ROCKING_DEG)[:, None, None]
    ups = np.cos(tilts) * up + np.sin(tilts) * around
    return bool((-(ups @ points.T).min(axis=-1)).min() >= -(points @ up).min() - SAME_HEIGHT)


def toppling_angle(points: Array, center_of_mass: Array, up: Array) -> float:
    """Angle in degrees by which a body can be tilted, in the worst direction, before it topples.

    Args:
        points: (V, 3) its corners, m.
        center_of_mass: (3,).
        up: (3,) unit, the direction of its frame that points up.
    """
    heights = points @ up
    feet = points[heights - heights.min() < BELOW]
    across = np.linalg.svd(up[None])[2][1:]
    outline = (feet - center_of_mass) @ across.T
    try:
        edges = ConvexHull(outline).equations
    except (QhullError, ValueError):
        return 0.0  # it stands on an edge or a corner
    reach = float((-edges[:, 2]).min())
    return float(np.degrees(np.arctan2(reach, center_of_mass @ up - heights.min())))
