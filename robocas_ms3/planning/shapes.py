"""What FCL checks of shapes: convex hulls, moved out a little, and octrees of points. Each is made once."""

from __future__ import annotations

import hashlib
import itertools
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from robocas_ms3.planning.protocol import Array, Shape

MARGIN = 0.0025  # m that obstacles are larger than they are: about what voxels of 5 mm add on average
KEPT = 16  # trees of the last clouds and hulls of the last held objects


@dataclass(frozen=True)
class Pieces:
    """What FCL checks of a shape.

    Attributes:
        geometries: of FCL, one a piece.
        vertices: (V, 3) of all pieces, in the shape's frame, m.
        first: (H,) index of each piece's first vertex.
    """

    geometries: list[Any]
    vertices: Array
    first: NDArray[np.int_]


class CollisionShapes:
    """Makes FCL's geometries and keeps them.

    Args:
        fcl: mplib's module of it.
        voxel: edge of the voxels of clouds = spacing of their points, m.
    """

    def __init__(self, fcl: Any, voxel: float) -> None:
        self._fcl, self._voxel = fcl, voxel
        self._shapes: WeakKeyDictionary[Shape, dict[float, Pieces]] = WeakKeyDictionary()
        self._recent: OrderedDict[bytes, Pieces] = OrderedDict()

    def obstacle(self, shape: Shape, room: float) -> Pieces:
        """Pieces of an obstacle's shape, its hulls moved out by ``room`` m and a margin."""
        sizes = self._shapes.setdefault(shape, {})
        if room not in sizes:
            sizes[room] = self._pieces(shape, room)
        return sizes[room]

    def cloud(self, points: Array) -> Pieces:
        """An octree of points (P, 3)."""
        return self._remember(points, self._tree)

    def hull(self, vertices: Array) -> Pieces:
        """The convex hull of points (V, 3), as it is."""
        return self._remember(np.ascontiguousarray(vertices, dtype=np.float64), self._hull)

    def object(self, geometry: Any, pose: Array | None = None) -> Any:
        """A collision object of a geometry at a pose (4x4); default: to be placed yet."""
        if pose is None:
            return self._fcl.CollisionObject(geometry)
        place = matrix_to_pose(pose)
        return self._fcl.CollisionObject(geometry, place[:3], place[3:])

    def _pieces(self, shape: Shape, room: float) -> Pieces:
        if shape.points is not None:
            return self._tree(np.ascontiguousarray(shape.points))
        hulls = [inflated(np.asarray(vertices, dtype=np.float64), MARGIN + room) for vertices in shape.hulls]
        first = np.cumsum([0, *(len(vertices) for vertices, _ in hulls[:-1])])
        geometries = [self._fcl.Convex(vertices, faces) for vertices, faces in hulls]
        return Pieces(geometries, np.concatenate([vertices for vertices, _ in hulls]), first)

    def _tree(self, points: Array) -> Pieces:
        ends = np.array([points.min(axis=0) - self._voxel, points.max(axis=0) + self._voxel])
        corners = np.array(list(itertools.product(*ends.T)))
        return Pieces([self._fcl.OcTree(points, self._voxel)], corners, np.zeros(1, dtype=int))

    def _hull(self, vertices: Array) -> Pieces:
        corners, faces, _ = convex_hull(vertices)
        return Pieces([self._fcl.Convex(corners, faces)], corners, np.zeros(1, dtype=int))

    def _remember(self, points: Array, make: Callable[[Array], Pieces]) -> Pieces:
        """Make something of points, or find what was made of them recently."""
        key = hashlib.blake2b(points.data).digest() + make.__name__.encode()
        made = self._recent.pop(key, None) or make(points)
        self._recent[key] = made
        if len(self._recent) > KEPT:
            self._recent.popitem(last=False)
        return made


def convex_hull(vertices: Array) -> tuple[Array, NDArray[np.int32], Array]:
    """Corners (V, 3) of the convex hull of points, its triangles (F, 3) seen from outside, and their normals (F, 3)."""
    hull = ConvexHull(vertices)
    outward = np.einsum("ij,ij->i", _normals(vertices, hull.simplices), hull.equations[:, :3]) > 0
    faces = np.where(outward[:, None], hull.simplices, hull.simplices[:, ::-1])
    used, faces = np.unique(faces, return_inverse=True)
    return vertices[used], faces.reshape(-1, 3).astype(np.int32), hull.equations[:, :3]


def inflated(vertices: Array, margin: float) -> tuple[Array, NDArray[np.int32]]:
    """Corners and triangles of a convex hull whose faces are moved out by ``margin``, its sharp edges a little less."""
    corners, faces, normals = convex_hull(vertices)
    square, total = np.tile(1e-3 * np.eye(3), (len(corners), 1, 1)), np.zeros((len(corners), 3))
    for corner in faces.T:  # all faces that meet in a corner move out; all but parallel ones along themselves
        np.add.at(square, corner, normals[:, :, None] * normals[:, None, :])
        np.add.at(total, corner, normals)
    out = margin * np.linalg.solve(square, total[:, :, None])[:, :, 0]
    out *= np.minimum(1.0, 2 * margin / np.linalg.norm(out, axis=1, keepdims=True))
    hull, faces, _ = convex_hull(corners + out)
    return hull, faces


def _normals(vertices: Array, faces: NDArray[np.int_]) -> Array:
    a, b, c = vertices[faces[:, 0]], vertices[faces[:, 1]], vertices[faces[:, 2]]
    return np.cross(b - a, c - a)


def bounds(part: Any, rotation: Array, position: Array) -> Array:
    """Give the box (2, 3) around a collision object, low and high corner, in a frame given in the base frame, m."""
    geometry = part.get_collision_geometry()
    if hasattr(geometry, "get_vertices"):
        vertices = np.array(geometry.get_vertices())
    else:
        vertices = np.array(geometry.side) / 2 * np.array(list(itertools.product((-1, 1), repeat=3)))
    points = vertices @ np.array(part.get_rotation()).T + np.array(part.get_translation())
    local = (points - position) @ rotation
    return np.array([local.min(axis=0), local.max(axis=0)])


def matrix_to_pose(matrix: Array) -> Array:
    """Turn a 4x4 matrix into (7,) x, y, z, qw, qx, qy, qz."""
    m = matrix[:3, :3]
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    # Bar-Itzhack's symmetric form, one row of 4 q q^T, chosen by its largest diagonal element: stable everywhere.
    diagonal = np.array([1 + trace, *(1 - trace + 2 * np.diag(m))])
    row = int(np.argmax(diagonal))
    wx, wy, wz = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    xy, xz, yz = m[0, 1] + m[1, 0], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1]
    wxyz = np.array(
        ((diagonal[0], wx, wy, wz), (wx, diagonal[1], xy, xz), (wy, xy, diagonal[2], yz), (wz, xz, yz, diagonal[3]))
    )
    quaternion = wxyz[row] / np.linalg.norm(wxyz[row])
    return np.concatenate([matrix[:3, 3], quaternion])
