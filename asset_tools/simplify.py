"""Reduce the number of faces for rendering without losing parts."""

from __future__ import annotations

import fast_simplification
import numpy as np
import trimesh
from numpy.typing import NDArray

from robocas_ms3.core.errors import AssetError

Array = NDArray[np.float64]

DENSE = 3  # times the limit
STUCK = 0.9  # fraction of faces left by a step; above, a more aggressive step follows
ENOUGH = 6  # times the limit is accepted for a mesh with many holes or pieces
GRIDS = (512, 362, 256, 181, 128, 91, 64, 45, 32, 16, 8)  # cells along the diagonal for merging vertices, fine first
LEFT = 0.8  # minimum fraction of area and volume after simplification; less means lost parts or holes


def simplify_mesh(mesh: trimesh.Trimesh, triangles: int) -> trimesh.Trimesh:
    """Return a mesh with few faces, merged vertices and outward faces.

    A mesh with many holes or pieces would lose parts. Such a mesh keeps up to six times the limit of faces. If the
    mesh would still lose parts, its vertices are merged on a grid.

    Args:
        mesh: mesh in any unit.
        triangles: limit of the number of faces.

    Raises:
        AssetError: no face is left.
    """
    body = merge_vertices(mesh)
    center, size = body.bounds.mean(axis=0), float(np.linalg.norm(body.extents))
    whole = (np.asarray(body.vertices) - center) / size, np.asarray(body.faces)
    most, area = ENOUGH * triangles, float(body.area)
    volume = abs(float(body.volume)) if body.is_watertight else 0.0

    def keeps_parts(vertices: Array, faces: NDArray) -> bool:
        light = trimesh.Trimesh(vertices * size, faces, process=False)
        return bool(light.area >= LEFT * area and abs(light.volume) >= LEFT * volume)

    found: list[tuple[Array, NDArray]] = []
    for limit in (triangles, 2 * triangles, 4 * triangles, most):
        found.append(_collapsed(*whole, limit))
        if len(found[-1][1]) > most or keeps_parts(*found[-1]):
            break
    if len(found[-1][1]) > most or not keeps_parts(*found[-1]):
        found += [_merged(*whole, cells) for cells in GRIDS]
    found = [part for part in found if len(part[1]) <= most]
    vertices, faces = next((part for part in found if keeps_parts(*part)), found[-1])
    if len(faces) == 0:
        raise AssetError(
            "all faces of the mesh are degenerate", expected=f"1 to {triangles} faces", found="no face left"
        )
    body = trimesh.Trimesh(vertices * size + center, faces, process=False)
    body.update_faces(body.nondegenerate_faces())
    body.remove_unreferenced_vertices()
    if not body.is_winding_consistent:
        trimesh.repair.fix_winding(body)
    if body.volume < 0:
        body.invert()
    return body


def merge_vertices(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return a copy of a mesh with vertices merged by position, and faces in the same order."""
    body = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    body.merge_vertices(digits_vertex=None)
    return body


def orient_outward(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return a copy of a mesh with vertices merged by position, and outward faces in the same order."""
    body = merge_vertices(mesh)
    if body.volume < 0:
        body.faces = np.array(body.faces)[:, ::-1]
    return body


def _collapsed(vertices: Array, faces: NDArray, triangles: int) -> tuple[Array, NDArray]:
    """Collapse edges until at most ``triangles`` faces are left, if possible.

    Returns:
        Vertices (V, 3) and faces (F, 3).
    """
    gentle = (2, 3) if len(faces) > DENSE * triangles else ()
    for aggression in (*gentle, 5, 7, 9, 12, 16, 20):  # the library may stop above the limit
        before = np.inf
        while triangles < len(faces) < STUCK * before:
            before = len(faces)  # in halves: a dense mesh folds over if it loses most of its faces at once
            target = max(triangles, before // 2) if gentle else triangles
            vertices, faces = fast_simplification.simplify(
                np.ascontiguousarray(vertices), faces.astype(np.int32), target_count=target, agg=aggression
            )[:2]
    return vertices, faces


def _merged(vertices: Array, faces: NDArray, cells: int) -> tuple[Array, NDArray]:
    """Merge the vertices in each cell of a grid with ``cells`` cells per unit of length.

    Returns:
        Vertices (V, 3) and the faces (F, 3) that are not degenerate.
    """
    _, cell, counts = np.unique(np.floor(vertices * cells), axis=0, return_inverse=True, return_counts=True)
    cell = cell.reshape(-1)
    means = np.stack([np.bincount(cell, column) / counts for column in vertices.T], axis=1)
    faces = cell[faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    return means, faces[np.unique(np.sort(faces, axis=1), axis=0, return_index=True)[1]]
