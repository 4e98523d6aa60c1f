"""Cleaning the faces of a scan: double ones, dirt, shells inside of others, faces that look the wrong way."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components

from robocas_ms3.errors import AssetError

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

LOOSE = 0.02  # share of the surface below which a separate piece is scanner dirt
# scans are written with 5 or 6 digits, so that corners of one point may differ in the last
SAME = 1e-6  # of the diagonal


@dataclass(frozen=True)
class CleanScan:
    """A scan without its dirt.

    Attributes:
        scan: as it was, colours and all, without the faces that were dropped; all faces outwards.
        welded: the same faces in the same order, without colours, seams closed.
    """

    scan: trimesh.Trimesh
    welded: trimesh.Trimesh


def clean(scan: trimesh.Trimesh, repairs: list[str]) -> CleanScan:
    """Drop faces that are no part of the outer surface, and turn all others outwards.

    Args:
        scan: any unit; may have UV seams, which are no gaps.
        repairs: gets a line for each thing that was mended.

    Raises:
        AssetError: no face has any size.
    """
    welded = _welded(scan, repairs)
    a, b, c = welded.faces.T
    kept = np.flatnonzero(welded.unique_faces() & (a != b) & (b != c) & (c != a))
    if len(kept) == 0:
        raise AssetError("the mesh has no faces of any size", expected="triangles", found=f"{len(scan.faces)} slivers")
    if len(kept) < len(scan.faces):
        repairs.append(f"dropped {_count(len(scan.faces) - len(kept), 'double or degenerate face')}")
        welded.update_faces(kept)
    outer = _outer_faces(welded, repairs)
    kept = kept[outer]
    welded.update_faces(outer)
    turned = _inward_faces(welded)
    if turned.any():
        every = turned.all()
        repairs.append("turned inside out" if every else f"turned {_count(int(turned.sum()), 'face')} outwards")
        faces = np.array(welded.faces)
        faces[turned] = faces[turned][:, ::-1]
        welded.faces = faces
    welded.remove_unreferenced_vertices()
    return CleanScan(_shown(scan, kept, turned, repairs), welded)


def _welded(scan: trimesh.Trimesh, repairs: list[str]) -> trimesh.Trimesh:
    """The scan's faces over vertices merged by position."""
    scale = 1 / (SAME * float(np.linalg.norm(np.ptp(scan.vertices[np.unique(scan.faces)], axis=0))))
    keys = np.rint(np.asarray(scan.vertices) * scale).astype(np.int64)
    _, first, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    uv: Any = getattr(scan.visual, "uv", None)
    different = keys if uv is None else np.column_stack([keys, np.rint(np.asarray(uv) * 1e6).astype(np.int64)])
    double = len(keys) - len(np.unique(different, axis=0))
    if double and "vertex_normals" not in scan._cache.cache:  # with normals, edges are double by right
        repairs.append(f"merged {_count(double, 'duplicate vertex', 'duplicate vertices')}")
    vertices = np.asarray(scan.vertices)[first]
    return trimesh.Trimesh(vertices, inverse.reshape(-1)[scan.faces], process=False)


def _outer_faces(mesh: trimesh.Trimesh, repairs: list[str]) -> Ints:
    """Indices of the faces that are neither dirt nor a shell inside of another piece."""
    links = np.asarray(mesh.face_adjacency).reshape(-1, 2)
    count = len(mesh.faces)
    graph = coo_matrix((np.ones(len(links), bool), (links[:, 0], links[:, 1])), shape=(count, count))
    number, piece = connected_components(graph, directed=False)
    if number < 2:
        return np.arange(count)
    areas = np.bincount(piece, mesh.area_faces, number)
    kept: list[int] = []
    shells: list[trimesh.Trimesh] = []
    for i in np.argsort(-areas, kind="stable"):
        if areas[i] < LOOSE * areas.sum():
            break
        faces = mesh.faces[piece == i]
        corners = mesh.vertices[np.unique(faces)]
        corners = corners[:: len(corners) // 50 + 1]
        if any(shell.is_watertight and shell.contains(corners).all() for shell in shells):
            continue
        kept.append(int(i))
        shells.append(trimesh.Trimesh(mesh.vertices, faces, process=False))
    if not kept:
        return np.arange(count)  # confetti, which closing will refuse
    if len(kept) < number:
        repairs.append(f"dropped {_count(number - len(kept), 'loose or inner piece')}")
    return np.flatnonzero(np.isin(piece, kept))


def _inward_faces(mesh: trimesh.Trimesh) -> NDArray[np.bool_]:
    """Faces to be turned so that neighbours agree and each piece has its faces outwards."""
    faces, count = np.asarray(mesh.faces), len(mesh.faces)
    links = np.asarray(mesh.face_adjacency).reshape(-1, 2)
    edges = np.asarray(mesh.face_adjacency_edges).reshape(-1, 2)
    # two faces agree when they run along their common edge in opposite directions
    disagree = _runs_along(faces[links[:, 0]], edges) == _runs_along(faces[links[:, 1]], edges)
    turned = np.zeros(count, bool)
    graph = coo_matrix((np.ones(len(links)), (links[:, 0], links[:, 1])), shape=(count, count)).tocsr()
    number, piece = connected_components(graph, directed=False)
    if disagree.any():
        values = coo_matrix((1.0 + disagree, (links[:, 0], links[:, 1])), shape=(count, count)).tocsr()
        values = values + values.T
        for start in np.unique(piece, return_index=True)[1]:
            order, before = breadth_first_order(graph, start, directed=False)
            if len(order) > 1:
                flips = np.asarray(values[before[order[1:]], order[1:]]).reshape(-1) > 1.5
                for face, parent, flip in zip(order[1:].tolist(), before[order[1:]].tolist(), flips, strict=True):
                    turned[face] = turned[parent] ^ flip
    corners = np.asarray(mesh.vertices)[faces]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) * np.where(turned, -1, 1)[:, None]
    middles = corners.mean(axis=1)
    sizes = np.maximum(np.bincount(piece, minlength=number), 1)
    # about its own middle, since a piece with a hole has another volume about any other point
    own = np.stack([np.bincount(piece, middles[:, axis], number) / sizes for axis in range(3)], axis=1)
    volumes = np.bincount(piece, (area * (middles - own[piece])).sum(axis=1), number)
    return turned ^ (volumes < 0)[piece]


def _runs_along(faces: Ints, edges: Ints) -> NDArray[np.bool_]:
    starts, ends = edges[:, :1], edges[:, 1:]
    return ((faces == starts) & (np.roll(faces, -1, axis=1) == ends)).any(axis=1)


def _shown(scan: trimesh.Trimesh, kept: Ints, turned: NDArray[np.bool_], repairs: list[str]) -> trimesh.Trimesh:
    """The scan with some of its faces, some of them turned; its normals dropped where they don't fit the faces."""
    shown, normals = scan.copy(), scan._cache.cache.get("vertex_normals")
    shown.update_faces(kept)
    if turned.any():
        faces = np.array(shown.faces)
        faces[turned] = faces[turned][:, ::-1]
        shown.faces = faces
    if normals is not None and len(normals) == len(shown.vertices):
        wrong = np.einsum("fi,fci->fc", shown.face_normals, normals[shown.faces]) < -0.1
        if wrong.mean() <= 0.01:
            shown.vertex_normals = normals
        elif not turned.any():
            repairs.append("dropped normals that look inwards")
    shown.remove_unreferenced_vertices()
    return shown


def _count(number: int, one: str, many: str = "") -> str:
    return f"{number} {one if number == 1 else many or one + 's'}"
