"""Find stable poses of a body from its convex hull, with probabilities and toppling angles."""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from robocas_ms3.core.errors import AssetError

Array = np.ndarray

LIMIT = 12  # maximum number of poses of an object
FALLBACK = 3  # number of tried poses if all are improbable
SAME_DEG = 5.0  # poses with a smaller angle between their up directions are equal
SAME_HEIGHT = 0.0005  # m: poses with equal height of the centre of mass form a family (a cylinder on its side)
UPRIGHT_DEG = 10.0
BELOW = 0.0004  # m: tolerated depth of corners below the plane
ROCKING_DEG = tuple(range(1, 11))  # tilts of the check for rocking


def find_stable_directions(hull: ConvexHull, center: Array) -> tuple[Array, Array, Array]:
    """Find the facets of a convex hull on which the body is stable.

    The probability of a facet is the solid angle of the facet, seen from the centre of mass. If the centre of mass is
    not above a facet, the body topples over an edge to another facet, which gets the probability
    (Goldberg et al. 1999).

    Args:
        hull: convex hull of the body, m.
        center: (3,) centre of mass, m.

    Returns:
        For each of N stable facets: the direction (N, 3) of the body's frame that points up, the probability (N,), and
        the height (N,) of the centre of mass in m. The most probable facet is first.
    """
    normals, heights = hull.equations[:, :3], -(hull.equations[:, :3] @ center + hull.equations[:, 3])
    if heights.min() <= 0:
        found, expected = f"a centre of mass at {np.round(center, 4).tolist()} m", "a point inside the convex hull"
        raise AssetError("the centre of mass is outside the hulls", expected=expected, found=found)
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
    # never uphill, so that rounding cannot cause cycles
    topples = (overhang.max(1) > 1e-7) & (heights[beyond] <= heights + 1e-9)
    follow = np.where(topples, beyond, here)
    for _ in range(int(np.log2(len(feet))) + 1):
        follow = follow[follow]
    pooled = np.bincount(follow, shares, len(feet))
    ends = np.flatnonzero(pooled > 0)
    return merge_poses(-normals[ends], pooled[ends] / pooled.sum(), heights[ends])


def merge_poses(directions: Array, probabilities: Array, heights: Array) -> tuple[Array, Array, Array]:
    """Merge poses whose up directions differ by less than 5 deg into the most probable of them.

    Args:
        directions: (N, 3) up directions.
        probabilities: (N,) probabilities.
        heights: (N,) heights of the centre of mass, m.

    Returns:
        Directions (M, 3), added probabilities (M,) and heights (M,) by descending probability.
    """
    kept: list[int] = []
    sums: list[float] = []
    # rounded, so that noise does not change the order of equal values
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
    """Return the indices of at most 12 poses to simulate.

    A family is a set of poses with equal height of the centre of mass. The upright pose is always first, since people
    place objects upright. Then follows one pose of each family that is probable enough, and then poses that differ in
    direction from the poses selected before.

    Args:
        directions: (N, 3) up directions.
        probabilities: (N,) probabilities.
        heights: (N,) heights of the centre of mass, m.
        minimum: smallest probability of a family.
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
    """Add the probability of each dropped pose to the nearest pose that is kept.

    Args:
        directions: (N, 3) up directions.
        probabilities: (N,) probabilities.
        kept: K indices of the poses that are kept.

    Returns:
        Probabilities (K,) of the kept poses.
    """
    nearest = (directions @ directions[kept].T).argmax(1)
    return np.bincount(nearest, probabilities, len(kept))


def rocks_in_place(points: Array, up: Array) -> bool:
    """Return whether a tilted body rocks back to about the same pose instead of toppling to another pose.

    Example: an oval bottle on its side, which has several facets with tiny toppling angles.

    Args:
        points: (V, 3) corners relative to the centre of mass, m.
        up: (3,) unit vector in the body's frame that points up.
    """
    across = np.linalg.svd(up[None])[2][1:]
    turns = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    around = np.cos(turns)[:, None] * across[0] + np.sin(turns)[:, None] * across[1]
    tilts = np.radians(ROCKING_DEG)[:, None, None]
    ups = np.cos(tilts) * up + np.sin(tilts) * around
    return bool((-(ups @ points.T).min(axis=-1)).min() >= -(points @ up).min() - SAME_HEIGHT)


def compute_toppling_angle(points: Array, center_of_mass: Array, up: Array) -> float:
    """Return the smallest angle in degrees by which the body must be tilted to topple.

    Args:
        points: (V, 3) corners, m.
        center_of_mass: (3,) m.
        up: (3,) unit vector in the body's frame that points up.
    """
    heights = points @ up
    feet = points[heights - heights.min() < BELOW]
    across = np.linalg.svd(up[None])[2][1:]
    outline = (feet - center_of_mass) @ across.T
    try:
        edges = ConvexHull(outline).equations
    except (QhullError, ValueError):
        return 0.0  # supported by an edge or a corner only
    reach = float((-edges[:, 2]).min())
    return float(np.degrees(np.arctan2(reach, center_of_mass @ up - heights.min())))
