"""Clean the faces of a scan: duplicates, inner walls and shells, scanner dirt, inward faces."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components

from robocas_ms3.core.errors import AssetError

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

LOOSE = 0.02  # fraction of the surface below which a separate piece may be scanner dirt
SPECK = 0.02  # of the diagonal: minimum size of closed pieces that are parts if they are near
NEAR = 0.01  # of the diagonal: largest distance of a part from the bounding box of another part
STICKS_OUT = 0.05  # of the diagonal: a piece or face that changes the bounding box by more is not dropped
DROPPED = 0.05  # largest fraction of the surface that is dropped as dirt, not counting flat scraps
FLAT = 0.001  # second largest over largest eigenvalue of the normals' covariance of a flat piece
# tolerance for equal vertices: files have 5 or 6 digits
SAME = 1e-6  # of the diagonal


@dataclass(frozen=True)
class CleanedScan:
    """A scan after cleaning, as two meshes with equal faces in equal order.

    All faces are oriented outwards.

    Attributes:
        scan: mesh with the colours and UV seams of the input.
        welded: mesh without colours, whose vertices are merged by position.
    """

    scan: trimesh.Trimesh
    welded: trimesh.Trimesh


def clean_scan(scan: trimesh.Trimesh, repairs: list[str]) -> CleanedScan:
    """Keep the faces of the outer surface of a scan, and orient these faces outwards.

    Args:
        scan: mesh in any unit; UV seams are allowed.
        repairs: list to which the function appends one note per repair.

    Raises:
        AssetError: all faces are degenerate.
    """
    welded = _welded(scan, repairs)
    a, b, c = welded.faces.T
    kept = np.flatnonzero(welded.unique_faces() & (a != b) & (b != c) & (c != a))
    if len(kept) == 0:
        raise AssetError(
            "all faces of the mesh are degenerate",
            expected="triangles with an area above 0",
            found=f"{len(scan.faces)} faces without area",
            fix="Export the mesh again.",
        )
    if len(kept) < len(scan.faces):
        repairs.append(f"dropped {_count(len(scan.faces) - len(kept), 'double or degenerate face')}")
        welded.update_faces(kept)
    if np.bincount(welded.edges_unique_inverse).max() > 2:
        welded, outer = _outer_boundary(welded)
        if len(outer) < len(kept):
            repairs.append(f"dropped {_count(len(kept) - len(outer), 'face')} inside of touching parts")
        kept = kept[outer]
    outer = _object_faces(welded, repairs)
    kept = kept[outer]
    welded.update_faces(outer)
    turned = _inward_faces(welded)
    if turned.any():
        all_turned = turned.all()
        repairs.append("turned inside out" if all_turned else f"turned {_count(int(turned.sum()), 'face')} outwards")
        faces = np.array(welded.faces)
        faces[turned] = faces[turned][:, ::-1]
        welded.faces = faces
    welded.remove_unreferenced_vertices()
    return CleanedScan(_shown(scan, kept, turned, repairs), welded)


def _welded(scan: trimesh.Trimesh, repairs: list[str]) -> trimesh.Trimesh:
    """Return the faces of a scan in the same order, with vertices merged by position, without colours."""
    scale = 1 / (SAME * float(np.linalg.norm(np.ptp(scan.vertices[np.unique(scan.faces)], axis=0))))
    keys = np.rint(np.asarray(scan.vertices) * scale).astype(np.int64)
    _, first, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    uv: Any = getattr(scan.visual, "uv", None)
    different = keys if uv is None else np.column_stack([keys, np.rint(np.asarray(uv) * 1e6).astype(np.int64)])
    double = len(keys) - len(np.unique(different, axis=0))
    if (
        double and "vertex_normals" not in scan._cache.cache
    ):  # with normals, duplicate vertices at sharp edges are correct
        repairs.append(f"merged {_count(double, 'duplicate vertex', 'duplicate vertices')}")
    vertices = np.asarray(scan.vertices)[first]
    return trimesh.Trimesh(vertices, inverse.reshape(-1)[scan.faces], process=False)


def _outer_boundary(mesh: trimesh.Trimesh) -> tuple[trimesh.Trimesh, Ints]:
    """Remove edges of more than two faces: drop inner walls, and separate parts that share an edge.

    The faces divide space into cells. Two faces that are neighbours around an edge enclose a cell between them. A face
    belongs to the outer surface if exactly one side of the face is in the unbounded cell.

    Returns:
        A mesh of the outer faces, in which the edges of closed parts have at most two faces.
        The indices (K,) of the outer faces in ``mesh``.
    """
    count = len(mesh.faces)
    edge, face = np.asarray(mesh.edges_unique_inverse), np.asarray(mesh.edges_face)
    upwards = (
        np.asarray(mesh.edges)[:, 0] < np.asarray(mesh.edges)[:, 1]
    )  # whether the face's edge runs to the vertex with the higher index
    order = _around_edges(mesh, upwards ^ _inward_faces(mesh)[face])
    ahead, behind = 2 * face + ~upwards, 2 * face + upwards  # sides that face ahead and back; 2 f is the front of f
    one, other = _neighbours(order, edge)
    cell = _components(ahead[one], behind[other], 2 * count)
    component = _components(face[one], face[other], count)
    tangled = np.unique(component[face[np.bincount(edge)[edge] > 2]])
    outside, kept = np.zeros(2 * count, bool), np.ones(count, bool)
    by_component = np.argsort(component, kind="stable")
    starts = np.searchsorted(component[by_component], [tangled, tangled + 1])
    for members in (by_component[low:high] for low, high in starts.T):
        unbounded = cell[2 * members[:, None] + [0, 1]] == cell[_outermost_side(mesh, members)]
        boundary = unbounded.sum(axis=1) == 1
        if boundary.any() and _box_change(mesh, members, members[boundary]) <= STICKS_OUT:
            outside[2 * members], outside[2 * members + 1] = unbounded.T
            kept[members] = boundary
    # corners of faces that enclose the same part of the inside share a vertex
    one, other = _neighbours(order[kept[face[order]]], edge)
    within = ~outside[ahead[one]]
    one, other = one[within], other[within]
    place = np.arange(3 * count).reshape(-1, 3)
    first, second = place.reshape(-1), np.roll(place, -1, axis=1).reshape(-1)
    low, high = np.where(upwards, first, second), np.where(upwards, second, first)
    vertex = _components(np.append(low[one], high[one]), np.append(low[other], high[other]), 3 * count)
    vertices = np.empty((vertex.max() + 1, 3))
    vertices[vertex] = np.asarray(mesh.vertices)[mesh.faces.reshape(-1)]
    return trimesh.Trimesh(vertices, vertex.reshape(-1, 3)[kept], process=False), np.flatnonzero(kept)


def _around_edges(mesh: trimesh.Trimesh, outside_ahead: NDArray[np.bool_]) -> Ints:
    """Return the half-edges (3 F,) sorted by edge, and around an edge by the angle of their faces.

    If two faces have the same angle, a face with the outside towards larger angles comes first: this face ends a part,
    and the other face starts the next part. If the outsides are equal, the face of the larger surface is outermost.

    Args:
        mesh: mesh with half-edges in the order of ``mesh.edges``.
        outside_ahead: (3 F,) whether the outside of the half-edge's face is on the side of larger angles.
    """
    vertices, edges = np.asarray(mesh.vertices), np.asarray(mesh.edges_sorted)
    start, end = vertices[edges[:, 0]], vertices[edges[:, 1]]
    tip = vertices[np.asarray(mesh.faces).sum(axis=1)[mesh.edges_face] - edges.sum(axis=1)]
    u = np.cross(end - start, np.eye(3)[np.abs(end - start).argmin(axis=1)])
    v = np.cross(end - start, u) / np.linalg.norm(end - start, axis=1, keepdims=True)
    angle = np.arctan2(((tip - start) * v).sum(axis=1), ((tip - start) * u).sum(axis=1))
    angle = np.round(np.where(angle < 0.0005 - np.pi, np.pi, angle), 3)
    piece = _pieces(mesh)
    area = np.bincount(piece, mesh.area_faces)[piece][mesh.edges_face]
    return np.lexsort((np.where(outside_ahead, area, -area), ~outside_ahead, angle, mesh.edges_unique_inverse))


def _neighbours(order: Ints, edge: Ints) -> tuple[Ints, Ints]:
    """Return pairs (H,), (H,) of half-edges that follow each other around an edge.

    Edges of one face have none.

    Args:
        order: (3 F,) half-edges, sorted by edge and around each edge.
        edge: (3 F,) edge of each half-edge.
    """
    first = np.flatnonzero(np.diff(edge[order], prepend=-1))
    following = np.arange(1, len(order) + 1)
    following[np.append(first[1:], len(order)) - 1] = first
    several = following != np.arange(len(order))
    return order[several], order[following[several]]


def _outermost_side(mesh: trimesh.Trimesh, faces: Ints) -> int:
    """Return an outer side, through which a ray from the largest face leaves the mesh.

    Returns:
        2 f for the front of face f, 2 f + 1 for its back.
    """
    a, b, c = np.asarray(mesh.vertices)[mesh.faces[faces]].transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    areas = np.linalg.norm(normals, axis=1)
    largest = int(areas.argmax())
    start = (a[largest] + b[largest] + c[largest]) / 3
    ray = normals[largest] / areas[largest] + [0.0123, 0.0345, 0.0234]  # tilted, so that it hits no edge
    slope = normals @ ray
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = ((a - start) * normals).sum(axis=1) / slope
        hits = start + distance[:, None] * ray
        for p, q in ((a, b), (b, c), (c, a)):
            distance[~((np.cross(q - p, hits - p) * normals).sum(axis=1) >= 0)] = -np.inf
    last = int(distance.argmax())
    return int(2 * faces[last] + (slope[last] < 0))


def _box_change(mesh: trimesh.Trimesh, faces: Ints, kept: Ints) -> float:
    """Return how much the bounding box of ``faces`` shrinks if only the faces ``kept`` stay.

    Returns:
        The largest motion of a side of the box, as a fraction of the box's diagonal.
    """
    corners, left = mesh.vertices[mesh.faces[faces]].reshape(-1, 3), mesh.vertices[mesh.faces[kept]].reshape(-1, 3)
    change = np.maximum(left.min(axis=0) - corners.min(axis=0), corners.max(axis=0) - left.max(axis=0))
    return float(change.max() / np.linalg.norm(np.ptp(corners, axis=0)))


def _pieces(mesh: trimesh.Trimesh) -> Ints:
    """Return the number (F,) of the connected piece of each face.

    Edges of more than two faces connect no faces.
    """
    one, other = np.asarray(mesh.face_adjacency).reshape(-1, 2).T
    return _components(one, other, len(mesh.faces))


def _components(one: Ints, other: Ints, count: int) -> Ints:
    """Return the number (N,) of the connected component of each node of a graph.

    Args:
        one: (E,) first node of each edge.
        other: (E,) second node of each edge.
        count: number of nodes N.
    """
    graph = coo_matrix((np.ones(len(one), bool), (one, other)), shape=(count, count))
    return connected_components(graph, directed=False)[1].astype(np.int64)


@dataclass(frozen=True)
class _Pieces:
    """The N connected pieces of a mesh.

    Attributes:
        faces: indices of the faces of each piece.
        low: (N, 3) lower corner of the bounding box of each piece.
        high: (N, 3) upper corner of the bounding box of each piece.
        shares: (N,) fraction of the surface of the mesh.
        closed: (N,) whether the piece has no open edge.
        flat: (N,) whether the piece is a flat scrap.
    """

    faces: list[Ints]
    low: Array
    high: Array
    shares: Array
    closed: NDArray[np.bool_]
    flat: NDArray[np.bool_]


def _object_faces(mesh: trimesh.Trimesh, repairs: list[str]) -> Ints:
    """Return the indices of the object's faces: neither scanner dirt nor a shell inside another piece."""
    piece = _pieces(mesh)
    if piece.max() == 0:
        return np.arange(len(mesh.faces))
    pieces = _measure_pieces(mesh, piece)
    parts = _are_parts(pieces)
    if not parts.all():
        share = 100 * float(pieces.shares[~parts].sum())
        repairs.append(f"dropped {_count(int((~parts).sum()), 'loose piece')} ({share:.2g} % of the surface)")
    kept: list[int] = []
    shells: dict[int, trimesh.Trimesh] = {}
    for i in np.argsort(-pieces.shares, kind="stable"):
        if not parts[i]:
            continue
        around = np.flatnonzero((pieces.low <= pieces.low[i]).all(axis=1) & (pieces.high >= pieces.high[i]).all(axis=1))
        corners = mesh.vertices[np.unique(mesh.faces[pieces.faces[i]])]
        for k in [k for k in around if k in kept and pieces.closed[k]]:
            if k not in shells:
                shells[k] = trimesh.Trimesh(mesh.vertices, mesh.faces[pieces.faces[k]], process=False)
            if shells[k].contains(corners[:: len(corners) // 50 + 1]).all():
                break
        else:
            kept.append(int(i))
    if len(kept) < parts.sum():
        repairs.append(f"dropped {_count(int(parts.sum()) - len(kept), 'inner piece')}")
    return np.sort(np.concatenate([pieces.faces[i] for i in kept]))


def _measure_pieces(mesh: trimesh.Trimesh, piece: Ints) -> _Pieces:
    """Measure the pieces of a mesh from the piece number (F,) of each face."""
    order = np.argsort(piece, kind="stable")
    starts = np.flatnonzero(np.diff(piece[order], prepend=-1))
    triangles, normals, areas = mesh.triangles[order], np.asarray(mesh.face_normals)[order], mesh.area_faces[order]
    rim = trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1)
    spread = np.linalg.eigvalsh(np.add.reduceat(areas[:, None, None] * normals[:, :, None] * normals[:, None], starts))
    return _Pieces(
        faces=np.split(order, starts[1:]),
        low=np.minimum.reduceat(triangles.min(axis=1), starts),
        high=np.maximum.reduceat(triangles.max(axis=1), starts),
        shares=np.add.reduceat(areas, starts) / areas.sum(),
        closed=np.bincount(piece[mesh.edges_face[rim]], minlength=len(starts)) == 0,
        flat=spread[:, 1] <= FLAT * spread[:, 2],
    )


def _are_parts(pieces: _Pieces) -> NDArray[np.bool_]:
    """Return a mask (N,) of the pieces that are parts of the object, not scanner dirt.

    Pieces of at least 2 % of the surface are parts. A smaller piece next to a part is also a part if it is closed and
    not tiny, or sticks out. Other pieces are dirt. If dirt has more than 5 % of the surface, its largest pieces are
    parts. Flat scraps are always dirt.
    """
    shares = pieces.shares
    parts = shares >= min(LOOSE, shares.max() / 2)
    sizes = (pieces.high - pieces.low).max(axis=1)
    growing = True
    while growing:
        low, high = pieces.low[parts].min(axis=0), pieces.high[parts].max(axis=0)
        diagonal = np.linalg.norm(high - low)
        sticks_out = np.maximum(low - pieces.low, pieces.high - high).max(axis=1) >= STICKS_OUT * diagonal
        likely = ~parts & ~pieces.flat & (sticks_out | (pieces.closed & (sizes >= SPECK * diagonal)))
        apart = [
            np.maximum(pieces.low[parts] - pieces.high[i], pieces.low[i] - pieces.high[parts]).max(axis=1).min()
            for i in np.flatnonzero(likely)
        ]
        near = np.flatnonzero(likely)[np.array(apart) <= NEAR * diagonal]
        parts[near] = True
        growing = len(near) > 0
    dirt = np.flatnonzero(~parts & ~pieces.flat)
    dirt = dirt[np.argsort(shares[dirt], kind="stable")]
    above = np.flatnonzero(np.cumsum(shares[dirt]) > DROPPED)
    if len(above):
        parts[dirt[shares[dirt] > shares[dirt[above[0]]] / 2]] = True  # pieces of similar size are treated equally
    return parts


def _inward_faces(mesh: trimesh.Trimesh) -> NDArray[np.bool_]:
    """Return a mask (F,) of the faces that must be flipped so that all faces are oriented outwards."""
    faces, count = np.asarray(mesh.faces), len(mesh.faces)
    links = np.asarray(mesh.face_adjacency).reshape(-1, 2)
    edges = np.asarray(mesh.face_adjacency_edges).reshape(-1, 2)
    # two faces agree if they traverse their common edge in opposite directions
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
    # relative to its own centre, since the volume of a piece with holes depends on the reference point
    own = np.stack([np.bincount(piece, middles[:, axis], number) / sizes for axis in range(3)], axis=1)
    volumes = np.bincount(piece, (area * (middles - own[piece])).sum(axis=1), number)
    return turned ^ (volumes < 0)[piece]


def _runs_along(faces: Ints, edges: Ints) -> NDArray[np.bool_]:
    starts, ends = edges[:, :1], edges[:, 1:]
    return ((faces == starts) & (np.roll(faces, -1, axis=1) == ends)).any(axis=1)


def _shown(scan: trimesh.Trimesh, kept: Ints, turned: NDArray[np.bool_], repairs: list[str]) -> trimesh.Trimesh:
    """Return the scan with only the faces ``kept``, with colours and, if they fit, normals.

    Args:
        scan: the scan before cleaning.
        kept: (K,) indices of the faces that stay.
        turned: (K,) whether to flip the face.
        repairs: list to which the function appends a note if the normals are dropped.
    """
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


def _count(number: int, singular: str, plural: str = "") -> str:
    return f"{number} {singular if number == 1 else plural or singular + 's'}"
