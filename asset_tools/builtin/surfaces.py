"""Patches for the usual surfaces: lofts of rings, sweeps along a planar curve, rounded boxes.

A ring is (half_x, half_y, z, exponent): a superellipse, 2 = ellipse, 4 = nearly a rounded rectangle. Rings run from the
bottom's centre outwards, up, and back to the axis, so that the surface closes. Angles start at the back (+y), so the
middle of a region's width faces the front (-y).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from asset_tools.builtin.mesh import Patch
from asset_tools.decompose import reduce_vertices


@dataclass(frozen=True)
class Section:
    """Consecutive rings that show one region of the texture.

    Args:
        region: its name.
        rings: (m, 4) half_x, half_y, z, exponent.
        flat: True maps the rings as seen from above or below (lids, bottoms), False unrolls them.
        detail: see ``Patch``.
    """

    region: str
    rings: np.ndarray
    flat: bool = False
    detail: float = 1.0


def soften(points: list[tuple[float, ...]], steps: int = 2) -> np.ndarray:
    """A polyline with rounded corners.

    Args:
        points: k coordinates and, last, the length cut off each side of that corner (0 keeps it sharp).
        steps: segments per rounded corner.

    Returns:
        (m, k) points.
    """
    data = np.array([point[:-1] for point in points], dtype=float)
    # A cut takes at most half of each neighbouring side.
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


def round_rings(profile: list[tuple[float, float, float]], steps: int = 2) -> np.ndarray:
    """Rings (m, 4) of a surface of revolution from (radius, z, corner cut), see ``soften``."""
    line = soften(list(profile), steps)
    return np.column_stack([line[:, 0], line[:, 0], line[:, 1], np.full(len(line), 2.0)])


def oval_rings(profile: list[tuple[float, float, float, float, float]], steps: int = 2) -> np.ndarray:
    """Rings (m, 4) from (half_x, half_y, z, exponent, corner cut)."""
    # Exponents are scaled down so that they don't count as lengths.
    line = soften([(a, b, z, n * 1e-3, cut) for a, b, z, n, cut in profile], steps)
    return np.column_stack([line[:, :3], line[:, 3] * 1e3])


def ring_points(rings: np.ndarray, segments: int) -> np.ndarray:
    """Points (m, segments + 1, 3) of the rings (m, 4); the last column repeats the first exactly."""
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
    """A closed part of rings; ``warp`` moves the points (..., 3) at the end, UVs stay as they were."""
    patches = []
    for section in sections:
        points = ring_points(section.rings, segments)
        uv, size = _flat_uv(points, section.rings) if section.flat else unrolled_uv(points)
        patches.append(Patch(section.region, points if warp is None else warp(points), uv, size, section.detail))
    return patches


def unrolled_uv(points: np.ndarray) -> tuple[np.ndarray, tuple[float, float]]:
    """UVs (m, n, 2) by arc length of a grid (m, n, 3), around its widest row and along its columns; its size in m."""
    around = np.linalg.norm(np.diff(points, axis=1), axis=2)
    widest = around[np.argmax(around.sum(1))]
    u = np.concatenate([[0], np.cumsum(widest)])
    along = np.linalg.norm(np.diff(points, axis=0), axis=2).mean(1)
    v = np.concatenate([[0], np.cumsum(along)])
    width, height = float(u[-1]), float(v[-1])
    uv = np.stack(np.broadcast_arrays((u / width)[None, :], (v / height)[:, None]), axis=-1)
    return uv, (width, height)


def _flat_uv(points: np.ndarray, rings: np.ndarray) -> tuple[np.ndarray, tuple[float, float]]:
    """UVs as seen from above, or from below where the rings grow outwards."""
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
    """A closed tube along a planar curve.

    Args:
        region: texture region: around the tube to the right, along it upwards.
        path: (m, 3) m.
        radii: (m, 2) across the plane's normal (inside the plane), and along the normal; the ends' are 0 to close it.
        normal: unit normal of the curve's plane.
        section: (segments,) factors on the radius around the tube, by default 1 (an ellipse).
        segments: around the tube.
        detail: see ``Patch``.
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
    uv, size = unrolled_uv(points)
    return [Patch(region, points, uv, size, detail)]


def stacked_pieces(patches: list[Patch], cuts: Sequence[float] = ()) -> list[np.ndarray]:
    """Convex pieces (k, 3) of an upright part, cut at heights where its profile is concave; hollows are filled.

    Args:
        patches: their rows are level.
        cuts: ascending heights, m.
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
        reduce_vertices(rows[(height >= low - 1e-9) & (height <= high + 1e-9)].reshape(-1, 3))
        for low, high in itertools.pairwise(edges)
    ]


def prism_piece(rings: Sequence[tuple[float, float]], sides: int = 16) -> np.ndarray:
    """Convex piece (k, 3) of an upright round part: regular polygons, of the area of its circles.

    Its facets are equal, so that it comes to rest on any of them; on unequal ones, as `reduce_vertices` leaves them, a
    round thing rocks for long. With up to three rings of 16 the engine keeps every corner.

    Args:
        rings: (radius, z) upwards, convex, m.
        sides: of the polygons.
    """
    angles = 2 * np.pi * (np.arange(sides) + 0.5) / sides
    larger = np.sqrt(2 * np.pi / sides / np.sin(2 * np.pi / sides))
    circle = larger * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return np.concatenate([np.column_stack([radius * circle, np.full(sides, z)]) for radius, z in rings])


def chained_pieces(patch: Patch, count: int) -> list[np.ndarray]:
    """Convex pieces (k, 3) of a swept tube, each of an equal share of its rings."""
    rows = patch.points[1:-1, :-1]
    bounds = np.round(np.linspace(0, len(rows) - 1, count + 1)).astype(int)
    return [reduce_vertices(rows[a : b + 1].reshape(-1, 3)) for a, b in itertools.pairwise(bounds.tolist())]


FACES = {  # right, up as seen from outside: (axis, sign) each
    "front": ((0, 1), (2, 1)),
    "back": ((0, -1), (2, 1)),
    "right": ((1, 1), (2, 1)),
    "left": ((1, -1), (2, 1)),
    "top": ((0, 1), (1, 1)),
    "bottom": ((0, 1), (1, -1)),
}


def rounded_box(
    size: tuple[float, float, float],
    radius: float,
    *,
    steps: int = 2,
    center: tuple[float, float, float] = (0, 0, 0),
    regions: dict[str, str] | None = None,
    detail: float = 1.0,
) -> list[Patch]:
    """A box with rounded edges, one patch a face: front (-y), back, right (+x), left, top, bottom.

    Args:
        size: outer size, m. radius: of all edges, m; 0 keeps them sharp. steps: segments of half an edge's rounding.
        center: of the box, m.
        regions: texture region of each face, by default the face's own name.
        detail: see ``Patch``.
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
