"""Make patches for common surfaces: lofts of rings, tubes along a planar curve, rounded boxes.

A ring is a horizontal superellipse (half_x, half_y, z, exponent); the exponent 2 is an ellipse, 4 is nearly a rounded
rectangle. The rings of a part run from the centre of the bottom outwards, upwards, and back to the axis, so that the
surface is closed. Angles start at the back (+y), so the middle of a region is at the front (-y).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from asset_tools.builtin.mesh import Patch
from asset_tools.decompose import reduce_hull_vertices


@dataclass(frozen=True)
class Section:
    """Consecutive rings that show one region of the texture.

    Args:
        region: name of the region.
        rings: (m, 4) rings: half_x, half_y, z, exponent; m.
        flat: whether the texture is projected from above or below, as for lids and bottoms; otherwise it is unrolled.
        detail: factor of the number of pixels per metre.
    """

    region: str
    rings: np.ndarray
    flat: bool = False
    detail: float = 1.0


def round_corners(points: list[tuple[float, ...]], steps: int = 2) -> np.ndarray:
    """Round the corners of a polyline.

    Args:
        points: for each corner k coordinates and, as the last number, the length that is cut off at both sides of the
            corner; 0 keeps the corner sharp.
        steps: number of segments per rounded corner.

    Returns:
        Points (m, k) of the new polyline.
    """
    data = np.array([point[:-1] for point in points], dtype=float)
    # a cut takes at most half of each adjacent side
    result = [data[0]]
    for i in range(1, len(data) - 1):
        back, ahead = data[i - 1] - data[i], data[i + 1] - data[i]
        sides = np.linalg.norm(back), np.linalg.norm(ahead)
        if points[i][-1] <= 0 or min(sides) == 0:
            result.append(data[i])
            continue
        start = data[i] + back * min(0.5, points[i][-1] / sides[0])
        end = data[i] + ahead * min(0.5, points[i][-1] / sides[1])
        t = np.linspace(0, 1, steps + 1)[:, None]
        result.extend((1 - t) ** 2 * start + 2 * t * (1 - t) * data[i] + t**2 * end)
    result.append(data[-1])
    keep = [0] + [i for i in range(1, len(result)) if np.linalg.norm(result[i] - result[i - 1]) > 1e-6]
    return np.array(result)[keep]


def make_circular_rings(profile: list[tuple[float, float, float]], steps: int = 2) -> np.ndarray:
    """Return the rings (m, 4) of a surface of revolution with rounded corners.

    Args:
        profile: for each corner of the profile the radius, the height z, and the length that is cut off to round it, m.
        steps: number of segments per rounded corner.
    """
    line = round_corners(list(profile), steps)
    return np.column_stack([line[:, 0], line[:, 0], line[:, 1], np.full(len(line), 2.0)])


def make_oval_rings(profile: list[tuple[float, float, float, float, float]], steps: int = 2) -> np.ndarray:
    """Return the rings (m, 4) of an oval surface with rounded corners.

    Args:
        profile: for each corner of the profile half_x, half_y, z, the exponent, and the length that is cut off to round
            it, m.
        steps: number of segments per rounded corner.
    """
    # exponents are scaled down so that they hardly count as lengths
    line = round_corners([(a, b, z, n * 1e-3, cut) for a, b, z, n, cut in profile], steps)
    return np.column_stack([line[:, :3], line[:, 3] * 1e3])


def compute_ring_points(rings: np.ndarray, segments: int) -> np.ndarray:
    """Return points (m, segments + 1, 3) on rings (m, 4), m; the last column is equal to the first column."""
    theta = np.pi / 2 + 2 * np.pi * np.arange(segments) / segments
    cos, sin = np.cos(theta), np.sin(theta)
    power = 2 / rings[:, 3:4]
    x = rings[:, 0:1] * np.sign(cos) * np.abs(cos) ** power
    y = rings[:, 1:2] * np.sign(sin) * np.abs(sin) ** power
    points = np.stack([x, y, np.broadcast_to(rings[:, 2:3], x.shape)], axis=-1)
    return np.concatenate([points, points[:, :1]], axis=1)


def loft(
    sections: list[Section], *, segments: int = 32, warp: Callable[[np.ndarray], np.ndarray] | None = None
) -> list[Patch]:
    """Return the patches of a closed part that consists of rings.

    Args:
        sections: sections of the part, from the bottom to the top.
        segments: number of segments around the part.
        warp: function that moves the points (..., 3) after the texture coordinates are computed.
    """
    patches = []
    for section in sections:
        points = compute_ring_points(section.rings, segments)
        uv, size = _flat_uv(points, section.rings) if section.flat else unroll_uv(points)
        patches.append(Patch(section.region, points if warp is None else warp(points), uv, size, section.detail))
    return patches


def unroll_uv(points: np.ndarray) -> tuple[np.ndarray, tuple[float, float]]:
    """Unroll a grid of points (m, n, 3) by arc length, along the longest row and along the columns.

    Returns:
        Texture coordinates (m, n, 2), and width and height of the region in m.
    """
    around = np.linalg.norm(np.diff(points, axis=1), axis=2)
    widest = around[np.argmax(around.sum(1))]
    u = np.concatenate([[0], np.cumsum(widest)])
    along = np.linalg.norm(np.diff(points, axis=0), axis=2).mean(1)
    v = np.concatenate([[0], np.cumsum(along)])
    width, height = float(u[-1]), float(v[-1])
    uv = np.stack(np.broadcast_arrays((u / width)[None, :], (v / height)[:, None]), axis=-1)
    return uv, (width, height)


def _flat_uv(points: np.ndarray, rings: np.ndarray) -> tuple[np.ndarray, tuple[float, float]]:
    """Project points (m, n, 3) on rings from above, or from below if the rings grow outwards.

    Returns:
        Texture coordinates (m, n, 2), and width and height of the region in m.
    """
    half = rings[:, :2].max(0)
    right = points[..., 0] * (-1 if rings[-1, 0] > rings[0, 0] else 1)
    uv = np.stack([0.5 + right / (2 * half[0]), 0.5 + points[..., 1] / (2 * half[1])], axis=-1)
    return uv, (float(2 * half[0]), float(2 * half[1]))


def sweep(
    region: str,
    path: np.ndarray,
    radii: np.ndarray,
    *,
    normal: tuple[float, float, float],
    section: np.ndarray | None = None,
    segments: int = 24,
    detail: float = 1.0,
) -> list[Patch]:
    """Return the patch of a closed tube along a planar curve, as a list.

    Args:
        region: name of the texture region. Its u runs around the tube, its v along the tube.
        path: (m, 3) points of the curve, m.
        radii: (m, 2) radius in the plane of the curve, and radius along the normal of the plane, m; 0 at both ends.
        normal: unit normal of the plane.
        section: (segments,) factors of the radius around the tube; None: 1, which is an ellipse.
        segments: number of segments around the tube.
        detail: factor of the number of pixels per metre.
    """
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    second = np.broadcast_to(np.asarray(normal, dtype=float), path.shape)
    first = np.cross(second, tangent)  # first x second = tangent, so angles run counterclockwise seen from its tip
    theta = 2 * np.pi * np.arange(segments) / segments
    factor = np.ones(segments) if section is None else section
    points = (
        path[:, None]
        + (radii[:, 0:1] * factor * np.cos(theta))[..., None] * first[:, None]
        + (radii[:, 1:2] * factor * np.sin(theta))[..., None] * second[:, None]
    )
    points = np.concatenate([points, points[:, :1]], axis=1)
    uv, size = unroll_uv(points)
    return [Patch(region, points, uv, size, detail)]


def make_stacked_pieces(patches: list[Patch], cuts: Sequence[float] = ()) -> list[np.ndarray]:
    """Cut an upright part at given heights; return the points (k, 3) of the convex hull of each section.

    Args:
        patches: patches of the part, whose rows are horizontal.
        cuts: ascending heights at which the profile is concave, m.
    """
    rows = np.concatenate([patch.points[:, :-1] for patch in patches])
    height = rows[:, 0, 2]
    edges = [-np.inf, *cuts, np.inf]
    for cut in cuts:
        low, high = height[:-1] - cut, height[1:] - cut
        for i in np.flatnonzero(low * high < 0):
            share = low[i] / (low[i] - high[i])
            rows = np.concatenate([rows, (1 - share) * rows[i : i + 1] + share * rows[i + 1 : i + 2]])
    height = rows[:, 0, 2]
    return [
        reduce_hull_vertices(rows[(height >= low - 1e-9) & (height <= high + 1e-9)].reshape(-1, 3))
        for low, high in itertools.pairwise(edges)
    ]


def make_prism_piece(rings: Sequence[tuple[float, float]], sides: int = 16) -> np.ndarray:
    """Return the points (k, 3) of a convex piece of a round, upright part: a regular polygon per circle.

    Each polygon has the area of its circle. All facets are equal, so that the object comes to rest on each of them. An
    object with unequal facets, as from `reduce_hull_vertices`, would rock for a long time. PhysX keeps all corners of
    up to three polygons of 16 sides.

    Args:
        rings: radius and height z of each circle, from the bottom to the top; convex, m.
        sides: number of sides of the polygons.
    """
    angles = 2 * np.pi * (np.arange(sides) + 0.5) / sides
    larger = np.sqrt(2 * np.pi / sides / np.sin(2 * np.pi / sides))
    circle = larger * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return np.concatenate([np.column_stack([radius * circle, np.full(sides, z)]) for radius, z in rings])


def make_chained_pieces(patch: Patch, count: int) -> list[np.ndarray]:
    """Cut a tube of `sweep` along its length into ``count`` sections.

    Return the points (k, 3) of each hull.
    """
    rows = patch.points[1:-1, :-1]
    bounds = np.round(np.linspace(0, len(rows) - 1, count + 1)).astype(int)
    return [reduce_hull_vertices(rows[a : b + 1].reshape(-1, 3)) for a, b in itertools.pairwise(bounds.tolist())]


FACES = {  # (axis, sign) of the directions right and up, seen from outside
    "front": ((0, 1), (2, 1)),
    "back": ((0, -1), (2, 1)),
    "right": ((1, 1), (2, 1)),
    "left": ((1, -1), (2, 1)),
    "top": ((0, 1), (1, 1)),
    "bottom": ((0, 1), (1, -1)),
}


def make_rounded_box(
    size: tuple[float, float, float],
    radius: float,
    *,
    steps: int = 2,
    center: tuple[float, float, float] = (0, 0, 0),
    regions: dict[str, str] | None = None,
    detail: float = 1.0,
) -> list[Patch]:
    """Return the patches of a box with rounded edges, one per face: front is -y, right is +x.

    Args:
        size: outer size (x, y, z), m.
        radius: radius of all edges, m; 0: sharp edges.
        steps: number of segments of half of a rounded edge.
        center: centre of the box, m.
        regions: name of a face -> name of its texture region; default: the name of the face.
        detail: factor of the number of pixels per metre.
    """
    half = np.asarray(size) / 2
    angles = np.linspace(0, np.pi / 4, steps + 1) if radius > 0 else np.zeros(1)
    angles = np.concatenate([-angles[::-1], angles])
    sign = np.repeat([-1.0, 1.0], len(angles) // 2)
    patches = []
    for name, ((right, right_sign), (up, up_sign)) in FACES.items():
        across = 3 - right - up
        outward = np.cross(np.eye(3)[right] * right_sign, np.eye(3)[up] * up_sign)
        direction = np.zeros((len(angles), len(angles), 3))
        direction[..., right] = right_sign * np.tan(angles)[None, :]
        direction[..., up] = up_sign * np.tan(angles)[:, None]
        direction[..., across] = outward[across]
        direction /= np.linalg.norm(direction, axis=2, keepdims=True)
        inner = np.zeros_like(direction)
        inner[..., right] = right_sign * sign[None, :] * (half[right] - radius)
        inner[..., up] = up_sign * sign[:, None] * (half[up] - radius)
        inner[..., across] = outward[across] * (half[across] - radius)
        u, v = (sign * (half[axis] - radius) + radius * angles for axis in (right, up))
        uv = np.stack(np.broadcast_arrays((u / (2 * u[-1]) + 0.5)[None, :], (v / (2 * v[-1]) + 0.5)[:, None]), axis=-1)
        region = (regions or {}).get(name, name)
        patches.append(Patch(region, inner + radius * direction + center, uv, (2 * u[-1], 2 * v[-1]), detail))
    return patches
