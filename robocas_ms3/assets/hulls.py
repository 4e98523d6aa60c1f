"""Read, write and sample the convex hulls of an asset (``hulls.obj``) in the asset's frame, in metres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from robocas_ms3.core.documents import read_text
from robocas_ms3.core.errors import AssetError
from robocas_ms3.core.text import format_count

Array = NDArray[np.float64]

_LIMIT = 2**26  # bytes of a file; a hull of 64 vertices has 5 kB
_HIDDEN_DEPTH = 0.0005  # m; points deeper inside another hull are not on the surface of the union
_BOX_TOLERANCE = 1e-5  # m; files round to 1e-7 m


@dataclass(frozen=True)
class Hull:
    """A convex hull: vertices (V, 3) in m, and faces (F, 3) as vertex indices."""

    vertices: Array
    faces: NDArray[np.int64]


@dataclass(frozen=True)
class Box:
    """A box: half of its size (3,) in m, and the pose (4, 4) of its centre in the frame of the hull."""

    half_size: Array
    pose: Array


def read_hulls(path: Path) -> list[Hull]:
    """Read the convex hulls of ``hulls.obj``, in which each hull is an ``o`` group of triangles."""
    vertices: list[list[float]] = []
    groups: list[list[list[int]]] = []
    try:
        for line in read_text(path, _LIMIT).splitlines():
            if line.startswith("v "):
                vertices.append([float(word) for word in line.split()[1:4]])
            elif line.startswith("o "):
                groups.append([])
            elif line.startswith("f "):
                groups[-1].append([int(word) - 1 for word in line.split()[1:4]])
        points = np.array(vertices, dtype=np.float64).reshape(-1, 3)
        hulls = []
        for group in groups:
            faces = np.array(group, dtype=np.int64).reshape(-1, 3)
            used, local = np.unique(faces, return_inverse=True)
            if len(used) and used[0] < 0:
                raise IndexError(f"a triangle with vertex number {used[0] + 1}; the first vertex has number 1")
            hulls.append(Hull(_frozen(points[used]), _frozen(local.reshape(-1, 3))))
        if not np.isfinite(points).all():
            raise ValueError("a vertex with NaN or infinite coordinates")
    except (OSError, ValueError, IndexError, OverflowError) as error:
        fix = "Make the pack again."
        raise AssetError("cannot read the convex hulls", where=path, found=str(error), fix=fix) from error
    if not hulls or any(len(hull.faces) < 4 for hull in hulls):
        expected, found = "at least one hull, each with at least 4 triangles", format_count(len(hulls), "hull")
        raise AssetError("invalid convex hulls", where=path, expected=expected, found=found, fix="Make the pack again.")
    return hulls


def write_hulls(path: Path, hulls: Sequence[Array]) -> None:
    """Write convex hulls of points (V, 3) to ``hulls.obj``, one ``o`` group per hull, with outward faces."""
    lines, offset = [], 1
    for number, points in enumerate(hulls):
        vertices, faces = make_convex_mesh(points)
        lines.append(f"o hull_{number}")
        lines += [f"v {x:.7f} {y:.7f} {z:.7f}" for x, y, z in vertices]
        lines += [f"f {a} {b} {c}" for a, b, c in faces + offset]
        offset += len(vertices)
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


def make_convex_mesh(points: Array) -> tuple[Array, NDArray[np.int64]]:
    """Return vertices (V, 3) and outward triangles (F, 3) of the convex hull of points (P, 3)."""
    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError) as error:
        expected, found = "at least 4 points that are not in one plane", format_count(len(points), "point")
        raise AssetError("no convex hull of these points", expected=expected, found=found) from error
    used, local = np.unique(hull.simplices, return_inverse=True)
    vertices, faces = np.asarray(points, dtype=np.float64)[used], local.reshape(-1, 3)
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = np.einsum("ij,ij->i", normals, hull.equations[:, :3]) < 0
    faces[inward] = faces[inward][:, ::-1]
    return vertices, faces


def find_box(vertices: Array) -> Box | None:
    """Return the box with the corners ``vertices`` (8, 3); None if they do not form a box.

    The axes are ordered so that the rotation is as small as possible. An axis-aligned box has no rotation.
    """
    if len(vertices) != 8:
        return None
    return _box_of(np.ascontiguousarray(vertices, dtype=np.float64).tobytes())


@lru_cache(maxsize=4096)  # the same furniture is built many times
def _box_of(corners: bytes) -> Box | None:
    vertices = np.frombuffer(corners).reshape(8, 3)
    center = vertices.mean(axis=0)
    edges = _edges(vertices[1:] - vertices[0])
    if edges is None:
        return None
    order = np.argsort(np.argmax(np.abs(edges), axis=1), kind="stable")
    edges = edges[order] * np.where(np.diagonal(edges[order]) < 0, -1.0, 1.0)[:, None]
    if np.linalg.det(edges) < 0:
        edges[2] *= -1
    # rotation that fits the edges best, weighted by their lengths
    left, _, right = np.linalg.svd(edges.T)
    axes = left @ right
    half = np.linalg.norm(edges, axis=1) / 2
    signs = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
    expected = center + (signs * half) @ axes.T
    distances = np.linalg.norm(vertices[:, None] - expected, axis=2)
    if max(distances.min(axis=0).max(), distances.min(axis=1).max()) > _BOX_TOLERANCE:
        return None
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = axes, center
    return Box(_frozen(half), _frozen(pose))


def _edges(vectors: Array) -> Array | None:
    """Return the three edges (3, 3) at a corner of a box, or None.

    Args:
        vectors: (7, 3) vectors from this corner to all other corners, m.
    """
    found: list[Array] = []
    for way in vectors[np.argsort(np.linalg.norm(vectors, axis=1), kind="stable")]:
        if all(abs(way @ edge) <= _BOX_TOLERANCE * np.linalg.norm(way) for edge in found):
            found.append(way)
    return np.stack(found) if len(found) == 3 else None


def slenderness(points: Array) -> float:
    """Return the slenderness of the convex hull of points (V, 3); a cube has 1.

    It is the greatest coordinate distance of a point from the centre of mass, divided by the least distance of the
    centre of mass from a face.
    """
    center = center_of_mass(points)
    depth = -(ConvexHull(points).equations @ np.append(center, 1.0)).max()
    return float(np.abs(points - center).max() / depth)


def center_of_mass(points: Array) -> Array:
    """Return the centre of mass (3,) of the convex hull of points (V, 3)."""
    inside = points.mean(axis=0)
    corners = points[ConvexHull(points).simplices] - inside
    volumes = np.abs(np.linalg.det(corners))
    return inside + volumes @ corners.sum(axis=1) / 4 / volumes.sum()


def sample_surface(hulls: Sequence[Hull], spacing: float) -> Array:
    """Return points (P, 3) on the surface of the union of convex hulls, about ``spacing`` m apart.

    Points of one hull inside another hull are left out. The result is deterministic.
    """
    equations = [ConvexHull(hull.vertices).equations for hull in hulls]
    kept = []
    for index, hull in enumerate(hulls):
        points = sample_triangles(hull.vertices[hull.faces], spacing)
        for other, planes in enumerate(equations):
            if other == index:
                continue
            low, high = hulls[other].vertices.min(axis=0), hulls[other].vertices.max(axis=0)
            close = np.flatnonzero(np.all((points >= low) & (points <= high), axis=1))  # only these can be inside
            if len(close):
                depth = np.max(points[close] @ planes[:, :3].T + planes[:, 3], axis=1)
                points = np.delete(points, close[depth <= -_HIDDEN_DEPTH], axis=0)
        kept.append(points)
    return downsample_points(np.concatenate(kept), spacing)


def sample_triangles(corners: Array, spacing: float) -> Array:
    """Return a grid of points (P, 3), at most ``spacing`` m apart, on triangles (F, 3, 3).

    The points include corners and points on edges.
    """
    lengths = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
    longest = np.argmax(lengths, axis=1)
    rows = np.arange(len(corners))
    a, b, c = (corners[rows, (longest + k) % 3] for k in range(3))
    base = lengths[rows, longest]
    height = np.linalg.norm(np.cross(b - a, c - a), axis=1) / np.maximum(base, 1e-12)
    counts = np.stack([np.ceil(base / spacing), np.ceil(height / spacing)], axis=1).astype(int).clip(1)
    points = []
    for along, up in np.unique(counts, axis=0):
        chosen = np.all(counts == (along, up), axis=1)
        s, t = (grid.ravel() for grid in np.meshgrid(np.linspace(0, 1, along + 1), np.linspace(0, 1, up + 1)))
        weights = np.stack([(1 - t) * (1 - s), (1 - t) * s, t], axis=1)
        points.append(np.einsum("pk,fki->fpi", weights, np.stack([a, b, c], axis=1)[chosen]).reshape(-1, 3))
    return np.concatenate(points)


def downsample_points(points: Array, spacing: float) -> Array:
    """Return the first of the points (P, 3) in each cell of a grid with the cell size ``spacing / 2``."""
    cells = np.floor(points / (spacing / 2) + 0.25).astype(np.int64)
    low, high = cells.min(axis=0), cells.max(axis=0)
    key = np.ravel_multi_index(tuple((cells - low).T), tuple(high - low + 1))  # one number per cell sorts faster
    first = np.unique(key, return_index=True)[1]
    return points[np.sort(first)]


def _frozen(array: NDArray) -> NDArray:
    array.setflags(write=False)
    return array
