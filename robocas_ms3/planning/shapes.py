"""Build and cache FCL geometries of obstacles: convex hulls with a margin, and octrees of points."""

from __future__ import annotations

import hashlib
import itertools
from collections import OrderedDict, defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any
from weakref import WeakKeyDictionary

import fcl
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from robocas_ms3.planning.protocol import Array, Shape

MARGIN = 0.0025  # m added to hulls, about the mean error of voxels of 5 mm
VOXEL = 0.005  # m, edge of the voxels of point clouds, equal to the spacing of their points
CACHE_SIZE = 16  # number of cached octrees and hulls of held objects
DEPTH = 16  # levels of an octree
OCCUPIED, INNER = 2, 3  # bits per child in a stream of octomap; 0: unknown


@dataclass(frozen=True)
class ConvexPieces:
    """FCL geometries of the H pieces of a shape; a piece is a convex hull or an octree.

    Attributes:
        geometries: H FCL geometries.
        vertices: (V, 3) vertices of all pieces in the shape's frame, m; for an octree, those of its bounding box.
        first: (H,) index of the first vertex of each piece.
        unused: FCL objects that no scene uses, by index of the piece; kept since python-fcl leaks memory per object.
    """

    geometries: list[Any]
    vertices: Array
    first: NDArray[np.int_]
    unused: dict[int, list[Any]] = field(default_factory=lambda: defaultdict(list))


class CollisionShapes:
    """Factory and cache of the FCL geometries of shapes, point clouds and held objects."""

    def __init__(self) -> None:
        self._shapes: WeakKeyDictionary[Shape, dict[float, ConvexPieces]] = WeakKeyDictionary()
        self._recent: OrderedDict[bytes, ConvexPieces] = OrderedDict()

    def obstacle_pieces(self, shape: Shape, clearance: float) -> ConvexPieces:
        """Return the pieces of a shape; the faces of hulls are moved out by ``clearance`` plus ``MARGIN``, m."""
        sizes = self._shapes.setdefault(shape, {})
        if clearance not in sizes:
            sizes[clearance] = self._pieces(shape, clearance)
        return sizes[clearance]

    def cloud_pieces(self, points: Array) -> ConvexPieces:
        """Return an octree of points (P, 3) as one piece.

        There is no piece if all points are outside the range of the octree.
        """
        return self._get_cached(points, self._tree)

    def hull_pieces(self, vertices: Array) -> ConvexPieces:
        return self._get_cached(np.ascontiguousarray(vertices, dtype=np.float64), self._hull)

    def _pieces(self, shape: Shape, clearance: float) -> ConvexPieces:
        if shape.points is not None:
            return self._tree(np.ascontiguousarray(shape.points))
        hulls = [inflate_hull(np.asarray(vertices, dtype=np.float64), MARGIN + clearance) for vertices in shape.hulls]
        first = np.cumsum([0, *(len(vertices) for vertices, _ in hulls[:-1])])
        geometries = [make_fcl_convex(vertices, faces) for vertices, faces in hulls]
        return ConvexPieces(geometries, np.concatenate([vertices for vertices, _ in hulls]), first)

    def _tree(self, points: Array) -> ConvexPieces:
        stream = encode_octree(points, VOXEL)
        if not stream:
            return ConvexPieces([], np.zeros((0, 3)), np.zeros(0, dtype=int))
        ends = np.array([points.min(axis=0) - VOXEL, points.max(axis=0) + VOXEL])
        corners = np.array(list(itertools.product(*ends.T)))
        return ConvexPieces([fcl.OcTree(VOXEL, stream)], corners, np.zeros(1, dtype=int))

    def _hull(self, vertices: Array) -> ConvexPieces:
        corners, faces, _ = convex_hull(vertices)
        return ConvexPieces([make_fcl_convex(corners, faces)], corners, np.zeros(1, dtype=int))

    def _get_cached(self, points: Array, make: Callable[[Array], ConvexPieces]) -> ConvexPieces:
        key = hashlib.blake2b(points.data).digest() + make.__name__.encode()
        made = self._recent.pop(key, None) or make(points)
        self._recent[key] = made
        if len(self._recent) > CACHE_SIZE:
            self._recent.popitem(last=False)
        return made


def make_fcl_convex(corners: Array, faces: NDArray[np.integer]) -> Any:
    polygons = np.concatenate([np.full((len(faces), 1), 3), faces], axis=1)  # size, corners
    return fcl.Convex(np.ascontiguousarray(corners, dtype=np.float64), len(faces), polygons.ravel().tolist())


def convex_hull(vertices: Array) -> tuple[Array, NDArray[np.int32], Array]:
    """Compute the convex hull of points (P, 3).

    Returns:
        Corners (V, 3); triangles (F, 3) as indices of corners, counter-clockwise seen from outside; outward unit
        normals (F, 3) of the triangles.
    """
    hull = ConvexHull(vertices)
    outward = np.einsum("ij,ij->i", _normals(vertices, hull.simplices), hull.equations[:, :3]) > 0
    faces = np.where(outward[:, None], hull.simplices, hull.simplices[:, ::-1])
    used, faces = np.unique(faces, return_inverse=True)
    return vertices[used], faces.reshape(-1, 3).astype(np.int32), hull.equations[:, :3]


def inflate_hull(vertices: Array, margin: float) -> tuple[Array, NDArray[np.int32]]:
    """Move the faces of the convex hull of points (P, 3) out by ``margin`` m.

    Corners move by at most twice the margin.

    Returns:
        Corners (V, 3); triangles (F, 3) as indices of corners, counter-clockwise seen from outside.
    """
    corners, faces, normals = convex_hull(vertices)
    square, total = np.tile(1e-3 * np.eye(3), (len(corners), 1, 1)), np.zeros((len(corners), 3))
    for corner in faces.T:  # least squares over the faces that meet at a corner
        np.add.at(square, corner, normals[:, :, None] * normals[:, None, :])
        np.add.at(total, corner, normals)
    out = margin * np.linalg.solve(square, total[:, :, None])[:, :, 0]
    out *= np.minimum(1.0, 2 * margin / np.linalg.norm(out, axis=1, keepdims=True))
    hull, faces, _ = convex_hull(corners + out)
    return hull, faces


def _normals(vertices: Array, faces: NDArray[np.integer]) -> NDArray[np.floating]:
    a, b, c = vertices[faces[:, 0]], vertices[faces[:, 1]], vertices[faces[:, 2]]
    return np.cross(b - a, c - a)


def encode_octree(points: Array, voxel: float) -> list[int]:
    """Encode the voxels that contain points (P, 3) as an octomap stream.

    python-fcl expects signed bytes.

    The octree has 2^16 voxels of edge ``voxel`` (m) per axis and is centred at the origin; points outside are dropped.
    The stream lists the inner nodes depth first with 16 bits per node: two bits per child.
    """
    keys = np.floor(points / voxel) + (1 << (DEPTH - 1))
    keys = keys[np.all((keys >= 0) & (keys < 1 << DEPTH), axis=1)].astype(np.int64)
    if not len(keys):
        return []
    codes = np.zeros(len(keys), dtype=np.int64)  # Morton order equals depth-first order
    for bit in range(DEPTH):
        for axis in range(3):
            codes |= ((keys[:, axis] >> bit) & 1) << (3 * bit + axis)
    children = np.unique(codes)
    masks, codes_of_nodes, depths = [], [], []
    for depth in range(DEPTH - 1, -1, -1):
        parents, first_child = np.unique(children >> 3, return_index=True)
        state = OCCUPIED if depth == DEPTH - 1 else INNER
        masks.append(np.bitwise_or.reduceat(np.int64(state) << (2 * (children & 7)), first_child))
        codes_of_nodes.append(parents << (3 * (DEPTH - depth)))  # code of the first voxel of the node
        depths.append(np.full(len(parents), depth))
        children = parents
    order = np.lexsort((np.concatenate(depths), np.concatenate(codes_of_nodes)))
    return np.concatenate(masks)[order].astype("<u2").view(np.int8).tolist()
