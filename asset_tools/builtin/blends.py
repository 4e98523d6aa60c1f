"""Solids as signed distance fields: primitives, smooth unions, and a closed mesh of a field.

A field maps points (n, 3) to distances (n,), negative inside; it needs to be right near the surface only. Lengths are
in millimetres, the unit that such things are drawn in. Turns are degrees about x, then y, then z.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import reduce

import fast_simplification
import numpy as np
import trimesh
from scipy.spatial.transform import Rotation
from skimage.measure import marching_cubes

Field = Callable[[np.ndarray], np.ndarray]
Point = tuple[float, float, float]

BLOCK = 8  # cells a side of the blocks that are left out where the surface can't be
LEAST = 0.08  # of a grid step: closer to a grid point the surface doesn't come
SLACK = 1.6  # fields may grow this much faster or slower than a distance

AXES = {"x": (1, 2, 0), "y": (2, 0, 1), "z": (0, 1, 2)}  # two axes across, and the axis


def ellipsoid(center: Point, radii: Point, turn: Point = (0, 0, 0)) -> Field:
    """Make an ellipsoid, turned about its centre."""
    scale = np.asarray(radii, np.float32)

    def field(points: np.ndarray) -> np.ndarray:
        local = _local(points, center, turn) / scale
        level = _length(local)
        return level * (level - 1) / np.maximum(_length(local / scale), 1e-6)

    return field


def chain(*knots: tuple[float, float, float, float]) -> Field:
    """Balls (x, y, z, radius), the hull of each two neighbours."""
    rows = np.asarray(knots, np.float32)

    def link(start: np.ndarray, end: np.ndarray) -> Field:
        along = end[:3] - start[:3]

        def field(points: np.ndarray) -> np.ndarray:
            offset = points - start[:3]
            t = np.clip(offset @ along / (along @ along), 0, 1)
            return _length(offset - t[:, None] * along) - (start[3] + t * (end[3] - start[3]))

        return field

    return union(*(link(a, b) for a, b in zip(rows[:-1], rows[1:], strict=True)))


def curve(*knots: tuple[float, float, float, float], steps: int = 5) -> Field:
    """A tube along a smooth (Catmull-Rom) curve through (x, y, z, radius)."""
    rows = np.asarray(knots, float)
    ends = np.vstack([2 * rows[:1] - rows[1:2], rows, 2 * rows[-1:] - rows[-2:-1]])
    t = np.linspace(0, 1, steps, endpoint=False)[:, None]
    smooth = [
        0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3)
        for a, b, c, d in zip(ends[:-3], ends[1:-2], ends[2:-1], ends[3:], strict=True)
    ]
    return chain(*np.vstack([*smooth, rows[-1:]]).tolist())


def box(center: Point, size: Point, radius: float = 0.0, turn: Point = (0, 0, 0)) -> Field:
    """A box with rounded edges."""
    half = np.asarray(size, np.float32) / 2 - radius

    def field(points: np.ndarray) -> np.ndarray:
        beyond = np.abs(_local(points, center, turn)) - half
        return _length(np.maximum(beyond, 0)) + np.minimum(beyond.max(1), 0) - radius

    return field


def turned(axis: str, center: Point, profile: Sequence[tuple[float, float]], radius: float = 0.0) -> Field:
    """A body of revolution about an axis ('x', 'y', 'z') through ``center``.

    Args:
        axis: of revolution. center: a point on it.
        profile: (along, radius) from one end to the other.
        radius: of its rounded edges.
    """
    # The closing edge is on the axis and gives no surface.
    line = polygon([(profile[0][0], 0.0), *profile, (profile[-1][0], 0.0)], closed=False)

    def field(points: np.ndarray) -> np.ndarray:
        across = _local(points, center)[:, AXES[axis]]
        return line(np.column_stack([across[:, 2], np.hypot(across[:, 0], across[:, 1])]))

    return field if radius == 0 else _rounded(field, radius)


def cylinder(axis: str, center: Point, length: float, radius: float, edge: float = 0.0) -> Field:
    """A cylinder along an axis, its rims rounded."""

    def field(points: np.ndarray) -> np.ndarray:
        across = _local(points, center)[:, AXES[axis]]
        beyond = np.column_stack(
            [np.hypot(across[:, 0], across[:, 1]) - radius + edge, np.abs(across[:, 2]) - length / 2 + edge]
        )
        return _length(np.maximum(beyond, 0)) + np.minimum(beyond.max(1), 0) - edge

    return field


def plate(
    axis: str, level: float, thickness: float, outline: Sequence[tuple[float, float]], *, edge: float = 0.0
) -> Field:
    """A flat plate with rounded rims.

    Args:
        axis: across the plate. level: of its middle on that axis.
        thickness: of it.
        outline: corners in the two other axes, in the order x, y, z.
        edge: radius of the rims; the outline is drawn in by it, then grown again, so convex corners get round.
    """
    plane = [i for i in range(3) if i != AXES[axis][2]]
    inside = polygon(outline)

    def field(points: np.ndarray) -> np.ndarray:
        beyond = np.column_stack(
            [inside(points[:, plane]) + edge, np.abs(points[:, AXES[axis][2]] - level) - thickness / 2 + edge]
        )
        return _length(np.maximum(beyond, 0)) + np.minimum(beyond.max(1), 0) - edge

    return field


def hoop(center: tuple[float, float], radii: tuple[float, float], half_width: float, half_height: float) -> Field:
    """A flat ring in the plane z = 0 along an ellipse; the ring's section is an ellipse too."""
    line = ellipsoid((*center, 0), (*radii, 1))

    def field(points: np.ndarray) -> np.ndarray:
        flat = points * np.array([1, 1, 0], np.float32)
        return np.hypot(line(flat), points[:, 2] * (half_width / half_height)) - half_width

    return field


def polygon(corners: Sequence[tuple[float, float]], *, closed: bool = True) -> Field:
    """Signed distance of points (n, 2) to the outline of a polygon; not ``closed``: to all but its last edge."""
    vertices = np.asarray(corners, np.float32)

    def field(points: np.ndarray) -> np.ndarray:
        squared = np.full(len(points), np.inf, np.float32)
        inside = np.zeros(len(points), bool)
        for i, (start, end) in enumerate(zip(vertices, np.roll(vertices, -1, axis=0), strict=True)):
            edge, offset = end - start, points - start
            if not edge.any():
                continue
            if closed or i < len(vertices) - 1:
                t = np.clip(offset @ (edge / (edge @ edge)), 0, 1)
                squared = np.minimum(squared, ((offset - t[:, None] * edge) ** 2).sum(1))
            crosses = (points[:, 1] >= start[1]) != (points[:, 1] >= end[1])
            inside ^= crosses & ((edge[0] * offset[:, 1] - edge[1] * offset[:, 0] < 0) == (edge[1] > 0))
        return np.where(inside, -np.sqrt(squared), np.sqrt(squared))

    return field


def both_sides(field: Field) -> Field:
    """Return the part at y > 0 and its mirror image."""
    return lambda points: field(np.column_stack([points[:, 0], np.abs(points[:, 1]), points[:, 2]]))


def moved(field: Field, offset: Point, turn: Point = (0, 0, 0)) -> Field:
    """A field turned about the origin, then moved."""
    return lambda points: field(_local(points, offset, turn))


def union(*fields: Field) -> Field:
    """All of them, creased where they meet."""
    return lambda points: reduce(np.minimum, (field(points) for field in fields))


def common(*fields: Field, reach: float = 0.0) -> Field:
    """What is inside all of them; ``reach`` rounds their edges, see ``smooth_min``."""
    return lambda points: -reduce(lambda a, b: smooth_min(a, b, reach), (-field(points) for field in fields))


def cut(field: Field, *tools: Field) -> Field:
    """A field without the tools."""
    return lambda points: reduce(np.maximum, (-tool(points) for tool in tools), field(points))


def smooth_min(first: np.ndarray, second: np.ndarray, reach: float) -> np.ndarray:
    """The lesser of two distances, rounded where they differ by less than ``reach``; it adds up to a quarter of it."""
    if reach <= 0:
        return np.minimum(first, second)
    share = np.maximum(reach - np.abs(first - second), 0) / reach
    return np.minimum(first, second) - share * share * reach / 4


def mesh_of(field: Field, low: Point, high: Point, *, step: float, triangles: int) -> trimesh.Trimesh:
    """The closed surface of a field, simplified; the same field gives the same mesh.

    Args:
        field: positive on the faces of the box from ``low`` to ``high``.
        low, high: what to look at.
        step: grid spacing; half of the thinnest part's thickness.
        triangles: about how many the mesh has.

    Raises:
        ValueError: the body sticks out of the box, is empty, or isn't closed when simplified.
    """
    values, corner = _sampled(field, np.asarray(low, float), np.asarray(high, float), step)
    border = [values[[0, -1]], values[:, [0, -1]], values[:, :, [0, -1]]]
    if min(float(face.min()) for face in border) <= 0 or values.min() >= 0:
        raise ValueError(f"the body is not inside of {low} to {high}")
    # A surface right through a grid point would give slivers that simplifying can't remove.
    least = LEAST * step
    values = np.where(np.abs(values) < least, np.where(values < 0, -least, least), values)
    vertices, faces = marching_cubes(values, 0.0, spacing=(step, step, step), gradient_direction="ascent")[:2]
    for aggression in (3, 5, 7):
        points, corners = fast_simplification.simplify(
            vertices.astype(np.float64), faces.astype(np.int32), target_count=min(triangles, len(faces)), agg=aggression
        )[:2]
        mesh = trimesh.Trimesh(points + corner, corners, process=False)
        if mesh.is_watertight and mesh.is_winding_consistent and len(mesh.faces) < 1.3 * triangles:
            break
    else:
        raise ValueError(f"simplified to {len(mesh.faces)} triangles, closed: {mesh.is_watertight}")
    if mesh.volume < 0:
        mesh.invert()
    return mesh


def _sampled(field: Field, low: np.ndarray, high: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Values on a grid and the grid's corner; blocks far from the surface get their middle's value."""
    # Level 0, where feet are cut off, falls between two levels of the grid: on one it would give slivers.
    corner = (np.floor(low / step) - 0.5) * step
    blocks = np.ceil((high - corner) / (step * BLOCK)).astype(int)
    middles = corner + (np.indices(tuple(blocks.tolist())).reshape(3, -1).T + 0.5) * (BLOCK * step)
    distance = field(middles.astype(np.float32))
    values = np.repeat(distance[:, None], BLOCK**3, axis=1).astype(np.float32)
    near = np.flatnonzero(np.abs(distance) < SLACK * (np.sqrt(3) * BLOCK / 2 + 1) * step)
    cells = np.indices((BLOCK, BLOCK, BLOCK)).reshape(3, -1).T * step
    starts = middles[near] - BLOCK * step / 2
    values[near] = field((starts[:, None] + cells).reshape(-1, 3).astype(np.float32)).reshape(len(near), -1)
    grid = values.reshape(*blocks, BLOCK, BLOCK, BLOCK).transpose(0, 3, 1, 4, 2, 5)
    return grid.reshape(tuple(blocks * BLOCK)), corner


def _local(points: np.ndarray, center: Point, turn: Point = (0, 0, 0)) -> np.ndarray:
    offset = points - np.asarray(center, np.float32)
    if not any(turn):
        return offset
    return offset @ Rotation.from_euler("xyz", turn, degrees=True).as_matrix().astype(np.float32)


def _rounded(field: Field, radius: float) -> Field:
    return lambda points: field(points) - radius


def _length(vectors: np.ndarray) -> np.ndarray:
    return np.sqrt(np.einsum("ij,ij->i", vectors, vectors))
