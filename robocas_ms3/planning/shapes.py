"""Build FCL geometries of obstacles: convex hulls with a margin, and octrees of points. Each is built once."""

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

MARGIN = 0.0025  # m that obstacles are larger than they are: about what voxels of 5 mm add on average
VOXEL = 0.005  # m, edge of the voxels of point clouds, equal to the spacing of their points
CACHE_SIZE = 16  # trees of the last clouds and hulls of the last held objects
DEPTH = 16  # levels of an octree
OCCUPIED, INNER = 2, 3  # bits per child in octomap's stream; 0: unknown


@dataclass(frozen=True)
class ConvexPieces:
    """The convex pieces of a shape.

    Attributes:
        vertices: (V, 3) of all pieces, in the shape's frame, m.
        first: (H,) index of each piece's first vertex.
        spares: unused FCL objects of each piece. They are kept, because python-fcl leaks memory with each object.
    """

    geometries: list[Any]
    vertices: Array
    first: NDArray[np.int_]
    unused: dict[int, list[Any]] = field(default_factory=lambda: defaultdict(list))


class CollisionShapes:
    """Builds FCL geometries and caches them."""

    def __init__(self) -> None:
        self._shapes: WeakKeyDictionary[Shape, dict[float, ConvexPieces]] = WeakKeyDictionary()
        self._recent: OrderedDict[bytes, ConvexPieces] = OrderedDict()

    def obstacle(self, shape: Shape, clearance: float) -> ConvexPieces:
        """Return the pieces of an obstacle's shape, its hulls enlarged by ``clearance`` (m) and a margin."""
        sizes = self._shapes.setdefault(shape, {})
        if clearance not in sizes:
            sizes[clearance] = self._pieces(shape, clearance)
        return sizes[clearance]

    def cloud(self, points: Array) -> ConvexPieces:
        """Return an octree of points (P, 3), or no piece where all of them are too far away for one."""
        return self._remember(points, self._tree)

    def hull(self, vertices: Array) -> ConvexPieces:
        return self._remember(np.ascontiguousarray(vertices, dtype=np.float64), self._hull)

    def _pieces(self, shape: Shape, clearance: float) -> ConvexPieces:
        if shape.points is not None:
            return self._tree(np.ascontiguousarray(shape.points))
        hulls = [inflate_hull(np.asarray(vertices, dtype=np.float64), MARGIN + clearance) for vertices in shape.hulls]
        first = np.cumsum([0, *(len(vertices) for vertices, _ in hulls[:-1])])
        geometries = [fcl_convex(vertices, faces) for vertices, faces in hulls]
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
        return ConvexPieces([fcl_convex(corners, faces)], corners, np.zeros(1, dtype=int))

    def _remember(self, points: Array, make: Callable[[Array], ConvexPieces]) -> ConvexPieces:
        key = hashlib.blake2b(points.data).digest() + make.__name__.encode()
        made = self._recent.pop(key, None) or make(points)
        self._recent[key] = made
        if len(self._recent) > CACHE_SIZE:
            self._recent.popitem(last=False)
        return made


def fcl_convex(corners: Array, faces: NDArray[np.integer]) -> Any:
    counted = np.concatenate([np.full((len(faces), 1), 3), faces], axis=1)  # each polygon starts with its size
    return fcl.Convex(np.ascontiguousarray(corners, dtype=np.float64), len(faces), counted.ravel().tolist())


def convex_hull(vertices: Array) -> tuple[Array, NDArray[np.int32], Array]:
    """Return the corners (V, 3) of the convex hull of points, its triangles (F, 3) and their outward normals (F, 3).

    The corners of a triangle are in counter-clockwise order as seen from outside.
    """
    hull = ConvexHull(vertices)
    outward = np.einsum("ij,ij->i", _normals(vertices, hull.simplices), hull.equations[:, :3]) > 0
    faces = np.where(outward[:, None], hull.simplices, hull.simplices[:, ::-1])
    used, faces = np.unique(faces, return_inverse=True)
    return vertices[used], faces.reshape(-1, 3).astype(np.int32), hull.equations[:, :3]


def inflate_hull(vertices: Array, margin: float) -> tuple[Array, NDArray[np.int32]]:
    """Return corners and triangles of a convex hull with its faces moved out by ``margin`` (m), sharp edges less."""
    corners, faces, normals = convex_hull(vertices)
    square, total = np.tile(1e-3 * np.eye(3), (len(corners), 1, 1)), np.zeros((len(corners), 3))
    for corner in faces.T:  # all faces that meet in a corner move out; all but parallel ones along themselves
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
    """Encode the voxels that contain points (P, 3) as octomap's stream, in signed bytes as python-fcl wants it.

    A tree holds 2^16 voxels along each axis, centred at the origin; points outside of it are dropped. The stream lists
    the inner nodes depth first; each is 16 bits, two for each of its 8 children.
    """
    keys = np.floor(points / voxel) + (1 << (DEPTH - 1))
    keys = keys[np.all((keys >= 0) & (keys < 1 << DEPTH), axis=1)].astype(np.int64)
    if not len(keys):
        return []
    codes = np.zeros(len(keys), dtype=np.int64)  # Morton order is the order of a depth-first traversal
    for bit in range(DEPTH):
        for axis in range(3):
            codes |= ((keys[:, axis] >> bit) & 1) << (3 * bit + axis)
    children = np.unique(codes)
    masks, codes_of_nodes, depths = [], [], []
    for depth in range(DEPTH - 1, -1, -1):
        parents, first_child = np.unique(children >> 3, return_index=True)
        state = OCCUPIED if depth == DEPTH - 1 else INNER
        masks.append(np.bitwise_or.reduceat(np.int64(state) << (2 * (children & 7)), first_child))
        codes_of_nodes.append(parents << (3 * (DEPTH - depth)))  # code of the node's first voxel
        depths.append(np.full(len(parents), depth))
        children = parents
    order = np.lexsort((np.concatenate(depths), np.concatenate(codes_of_nodes)))
    return np.concatenate(masks)[order].astype("<u2").view(np.int8).tolist()
