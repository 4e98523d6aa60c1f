"""Model solids as signed distance fields: primitives, smooth unions, and conversion to a closed mesh.

A field is a function from points (n, 3) to signed distances (n,), negative inside. Distances must be accurate only near
the surface. Lengths are in millimetres. A ``turn`` is a rotation in degrees about x, then y, then z.
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

BLOCK = 8  # cells per side of a block; a block is skipped if the surface cannot be in it
LEAST = 0.08  # of a grid step: minimum distance of the surface from a grid point
SLACK = 1.6  # largest ratio of the growth of a field to that of a distance

AXES = {"x": (1, 2, 0), "y": (2, 0, 1), "z": (0, 1, 2)}  # two axes across, and the axis


def ellipsoid(center: Point, radii: Point, turn: Point = (0, 0, 0)) -> Field:
    """Return the field of an ellipsoid, rotated about its centre."""
    scale = np.asarray(radii, np.float32)

    def field(points: np.ndarray) -> np.ndarray:
        local = _local(points, center, turn) / scale
        level = _length(local)
        return level * (level - 1) / np.maximum(_length(local / scale), 1e-6)

    return field


def chain(*knots: tuple[float, float, float, float]) -> Field:
    """Return the field of a chain: the convex hulls of consecutive balls (x, y, z, radius)."""
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
    """Return the field of a tube along a smooth (Catmull-Rom) curve through balls (x, y, z, radius).

    Args:
        knots: x, y, z and radius of each ball.
        steps: number of straight segments between two balls.
    """
    rows = np.asarray(knots, float)
    ends = np.vstack([2 * rows[:1] - rows[1:2], rows, 2 * rows[-1:] - rows[-2:-1]])
    t = np.linspace(0, 1, steps, endpoint=False)[:, None]
    smooth = [
        0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3)
        for a, b, c, d in zip(ends[:-3], ends[1:-2], ends[2:-1], ends[3:], strict=True)
    ]
    return chain(*np.vstack([*smooth, rows[-1:]]).tolist())


def box(center: Point, size: Point, radius: float = 0.0, turn: Point = (0, 0, 0)) -> Field:
    """Return the field of a box with edges of a radius, rotated about its centre."""
    half = np.asarray(size, np.float32) / 2 - radius

    def field(points: np.ndarray) -> np.ndarray:
        beyond = np.abs(_local(points, center, turn)) - half
        return _length(np.maximum(beyond, 0)) + np.minimum(beyond.max(1), 0) - radius

    return field


def revolve(axis: str, center: Point, profile: Sequence[tuple[float, float]], radius: float = 0.0) -> Field:
    """Return the field of a body of revolution about an axis.

    Args:
        axis: direction of the axis: "x", "y" or "z".
        center: a point on the axis.
        profile: (position along the axis, radius) from one end to the other.
        radius: radius of rounded edges.
    """
    # the edge on the axis is not a part of the surface
    line = polygon([(profile[0][0], 0.0), *profile, (profile[-1][0], 0.0)], closed=False)

    def field(points: np.ndarray) -> np.ndarray:
        across = _local(points, center)[:, AXES[axis]]
        return line(np.column_stack([across[:, 2], np.hypot(across[:, 0], across[:, 1])]))

    return field if radius == 0 else _rounded(field, radius)


def cylinder(axis: str, center: Point, length: float, radius: float, edge: float = 0.0) -> Field:
    """Return the field of a cylinder along an axis, with rims of the radius ``edge``."""

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
    """Return the field of a flat plate with rounded rims.

    Args:
        axis: axis perpendicular to the plate: "x", "y" or "z".
        level: position of the middle of the plate on this axis.
        thickness: thickness of the plate.
        outline: corners of the plate, as coordinates on the two other axes in the order x, y, z.
        edge: radius of the rims and of convex corners of the outline.
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
    """Return the field of a ring in the plane z = 0 along an ellipse.

    The section of the ring is also an ellipse.

    Args:
        center: x and y of the centre of the ring.
        radii: radii of the ellipse along x and y.
        half_width: half of the horizontal width of the section.
        half_height: half of the height of the section.
    """
    line = ellipsoid((*center, 0), (*radii, 1))

    def field(points: np.ndarray) -> np.ndarray:
        flat = points * np.array([1, 1, 0], np.float32)
        return np.hypot(line(flat), points[:, 2] * (half_width / half_height)) - half_width

    return field


def polygon(corners: Sequence[tuple[float, float]], *, closed: bool = True) -> Field:
    """Return the field of a polygon: signed distances (n,) of points (n, 2) from the outline.

    Args:
        corners: corners of the polygon.
        closed: whether distances from the edge between the last and the first corner also count.
    """
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


def mirror_y(field: Field) -> Field:
    """Return the field of the part at y > 0 and its mirror image."""
    return lambda points: field(np.column_stack([points[:, 0], np.abs(points[:, 1]), points[:, 2]]))


def transform(field: Field, offset: Point, turn: Point = (0, 0, 0)) -> Field:
    """Return the field of a solid that is rotated about the origin and then moved by ``offset``."""
    return lambda points: field(_local(points, offset, turn))


def union(*fields: Field) -> Field:
    """Return the field of the union of solids, with sharp creases."""
    return lambda points: reduce(np.minimum, (field(points) for field in fields))


def intersect(*fields: Field, reach: float = 0.0) -> Field:
    """Return the field of the intersection of solids; ``reach`` rounds the edges, see `smooth_min`."""
    return lambda points: -reduce(lambda a, b: smooth_min(a, b, reach), (-field(points) for field in fields))


def subtract(field: Field, *tools: Field) -> Field:
    """Return the field of a solid without the volume of the solids ``tools``."""
    return lambda points: reduce(np.maximum, (-tool(points) for tool in tools), field(points))


def smooth_min(first: np.ndarray, second: np.ndarray, reach: float) -> np.ndarray:
    """Return the smooth minimum (n,) of two distances (n,).

    If the distances differ by less than ``reach``, the result is lower than the minimum, by at most ``reach / 4``.
    """
    if reach <= 0:
        return np.minimum(first, second)
    share = np.maximum(reach - np.abs(first - second), 0) / reach
    return np.minimum(first, second) - share * share * reach / 4


def mesh_field(field: Field, low: Point, high: Point, *, step: float, triangles: int) -> trimesh.Trimesh:
    """Convert a field to a simplified, closed mesh; deterministic.

    Args:
        field: field of a solid inside the box.
        low: lower corner of the box, mm.
        high: upper corner of the box, mm.
        step: grid spacing, at most half of the smallest thickness, mm.
        triangles: approximate number of triangles of the mesh.

    Raises:
        ValueError: the solid is not inside the box, is empty, or cannot be simplified to a closed mesh.
    """
    values, corner = _sampled(field, np.asarray(low, float), np.asarray(high, float), step)
    border = [values[[0, -1]], values[:, [0, -1]], values[:, :, [0, -1]]]
    if min(float(face.min()) for face in border) <= 0 or values.min() >= 0:
        raise ValueError(f"the solid is empty or not inside the box from {low} to {high}: enlarge the box")
    # a surface through a grid point would give slivers that simplification cannot remove
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
        limit = f"a watertight mesh with fewer than {1.3 * triangles:.0f} triangles"
        found = f"{len(mesh.faces)} triangles, watertight: {mesh.is_watertight}"
        raise ValueError(f"cannot simplify the mesh: expected {limit}, found {found}. Increase `triangles`.")
    if mesh.volume < 0:
        mesh.invert()
    return mesh


def _sampled(field: Field, low: np.ndarray, high: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Sample a field on a grid; return the values (x, y, z) and the position (3,) of the first value.

    All values of a block far from the surface are the value at its centre.
    """
    # z = 0, where models are cut off, is between two grid planes, since a surface on a grid plane gives slivers
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
