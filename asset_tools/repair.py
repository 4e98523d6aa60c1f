"""Closing scans: from whatever a scanner left to a solid whose volume, hulls and grasps can be trusted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh
from manifold3d import Manifold, OpType
from numpy.typing import NDArray
from scipy.spatial import KDTree, QhullError
from trimesh.visual.color import ColorVisuals
from trimesh.visual.texture import TextureVisuals

from asset_tools.clean import clean_scan
from asset_tools.solids import to_mesh, to_solid
from robocas_ms3.core.errors import AssetError

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

FILLED = 0.35  # share of the surface that may be filled in
HOPELESS = 0.4  # share of the edges that are open: no surface, but confetti
LEAST_VOLUME = 0.01  # of the convex hull's: less is a sheet, not a body
FOIL = 1e-5  # thickness over diagonal, below which a body is a sheet as well
FACES = 5000  # of the solid at most; more only costs time
SIMPLIFIED_VOLUME = 0.05  # share of the volume that simplifying may change: more removes thin parts
TOLERANCES = (0.0005, 0.001, 0.0015, 0.002, 0.003)  # of the diagonal, tried in turn to get there
LOST = 0.03  # of the diagonal: how far from the mesh's ends the solid may end
MOST_PIECES = 1000
CRUMB = 0.001  # of the largest body's volume: smaller ones of a new mesh are noise
CELLS = 64  # of the grid that a mesh is re-meshed on, along its longest side
WINDING_SAMPLES, WINDING_CHUNK = 4000, 2048
NEIGHBOURS = 6  # samples that tell on which side of the surface a point near it lies


@dataclass(frozen=True)
class ClosedScan:
    """A solid made of a scan.

    Attributes:
        mesh: watertight, faces outwards, in the scan's frame and unit.
        scan: to look at: without dirt and inner shells, faces outwards.
        repairs: what had to be mended, in words.
    """

    mesh: trimesh.Trimesh
    scan: trimesh.Trimesh
    repairs: tuple[str, ...]


def close_scan(scan: trimesh.Trimesh) -> ClosedScan:
    """Make a watertight solid of a scan: weld, drop dirt, turn faces outwards, fill holes; else mesh it anew.

    A shell inside of the outer surface (an empty can scanned through) is dropped: things are solid.

    Args:
        scan: any unit; may have UV seams.

    Raises:
        AssetError: it encloses nothing (a sheet), or can't be closed.
    """
    repairs: list[str] = []
    cleaned = clean_scan(scan, repairs)
    mesh, shown = cleaned.welded, cleaned.scan
    if not mesh.is_watertight:
        mesh, shown = _filled(mesh, shown, repairs)
    solid = _as_solid(mesh)
    if solid is None:
        solid = _union_of_pieces(mesh, repairs)
    if solid is None and _open_edges(mesh) <= HOPELESS * len(mesh.edges_unique):
        solid = _as_solid(_remeshed(mesh))
        repairs.append("remeshed around the scan")
    diagonal = float(np.linalg.norm(shown.extents))
    if solid is None or solid.volume() < max(LEAST_VOLUME * _hull_volume(mesh), FOIL * shown.area * diagonal):
        raise AssetError(
            "the mesh can't be closed to a solid",
            expected=f"at most small holes, and at least {LEAST_VOLUME:.0%} of the convex hull's volume",
            found=f"{_open_edges(mesh)} open edges of {len(mesh.edges_unique)}, in {mesh.body_count} pieces",
            fix="Repair the scan, or leave it out.",
        )
    closed = _light(solid, diagonal)
    lost = float(np.abs(closed.bounds - shown.bounds).max())
    if lost > LOST * diagonal:
        raise AssetError(
            "closing the mesh would lose a part of it",
            expected=f"a solid that ends within {LOST:.0%} of where the mesh does",
            found=f"{lost / diagonal:.0%} of its diagonal missing",
            fix="Repair the mesh: join its parts to one closed surface.",
        )
    return ClosedScan(closed, shown, tuple(repairs))


def _hull_volume(mesh: trimesh.Trimesh) -> float:
    """Return the volume of the convex hull, 0 for a flat mesh."""
    try:
        return float(mesh.convex_hull.volume)
    except QhullError:
        return 0.0


def _filled(
    mesh: trimesh.Trimesh, shown: trimesh.Trimesh, repairs: list[str]
) -> tuple[trimesh.Trimesh, trimesh.Trimesh]:
    """Close each hole by a fan around its middle, if its rim is a simple loop; the same in the mesh to look at."""
    rim_edges = trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1)
    edges = mesh.edges[rim_edges]
    following = {int(a): int(b) for b, a in edges}  # the fill runs along the rim the other way
    if len(following) < len(edges) or not following:
        return mesh, shown  # holes meet in a vertex, or more than two faces in an edge: left to re-meshing
    middles: dict[int, Any] = {}
    vertices, faces = [np.asarray(mesh.vertices)], [np.asarray(mesh.faces)]
    count, holes, area = len(mesh.vertices), 0, 0.0
    while following:
        start, end = following.popitem()
        loop = [start]
        while end != start:
            loop.append(end)
            if end not in following:
                return mesh, shown
            end = following.pop(end)
        rim = mesh.vertices[loop]
        middle = np.asarray(rim).mean(axis=0)
        middles |= dict.fromkeys(loop, middle)
        area += float(np.linalg.norm(np.cross(rim - middle, np.roll(rim, -1, axis=0) - middle), axis=1).sum() / 2)
        vertices.append(middle[None])
        faces.append(np.column_stack([loop, np.roll(loop, -1), np.full(len(loop), count + holes)]))
        holes += 1
    if area > FILLED * mesh.area:
        raise AssetError(
            "the mesh can't be closed to a solid",
            expected=f"holes of at most {FILLED:.0%} of its surface",
            found=f"{area / mesh.area:.0%}",
            fix="Scan it from all sides, or leave it out.",
        )
    repairs.append(f"filled {holes} hole{'s' if holes > 1 else ''}")
    filled = trimesh.Trimesh(np.concatenate(vertices), np.concatenate(faces), process=False)
    face, corner = np.asarray(mesh.edges_face)[rim_edges], np.asarray(rim_edges, np.int64) % 3
    return filled, _patched(shown, face, corner, np.array([middles[int(a)] for a in edges[:, 0]]))


def _patched(shown: trimesh.Trimesh, face: Ints, corner: Ints, middles: Array) -> trimesh.Trimesh:
    """A mesh with a triangle from each edge at a hole's rim to the hole's middle, in the colours of the edge.

    Args:
        shown: textured or coloured.
        face: (E,) that each edge belongs to.
        corner: (E,) of the face, at which the edge begins.
        middles: (E, 3) of the hole that each is at.
    """
    old = np.asarray(shown.faces)
    first, second = old[face, corner], old[face, (corner + 1) % 3]
    tips = len(shown.vertices) + np.arange(len(face))
    vertices = np.concatenate([shown.vertices, middles])
    faces = np.concatenate([old, np.column_stack([second, first, tips])])
    visual: Any = shown.visual
    uv = getattr(visual, "uv", None)
    if uv is not None:
        uv = np.concatenate([uv, (uv[first] + uv[second]) / 2])
        visual = TextureVisuals(uv=uv, material=visual.material)
    elif visual.kind == "face":
        visual = ColorVisuals(face_colors=np.concatenate([visual.face_colors, visual.face_colors[face]]))
    elif visual.kind == "vertex":
        visual = ColorVisuals(vertex_colors=np.concatenate([visual.vertex_colors, visual.vertex_colors[first]]))
    else:
        visual = None
    attributes: Any = {
        name: np.concatenate([values, np.asarray(values)[first]]) for name, values in shown.vertex_attributes.items()
    }
    return trimesh.Trimesh(vertices, faces, visual=visual, vertex_attributes=attributes, process=False)


def _as_solid(mesh: trimesh.Trimesh) -> Manifold | None:
    """The mesh as a solid with outward faces; none if it isn't closed or encloses nothing."""
    if not mesh.is_watertight:
        return None
    if mesh.volume < 0:
        mesh.invert()
    solid = to_solid(mesh)
    if solid is None or solid.volume() <= 0:
        return None
    bodies = [body for body in solid.decompose() if body.volume() > 0]
    return Manifold.batch_boolean(bodies, OpType.Add)  # where they overlap would count twice


def _union_of_pieces(mesh: trimesh.Trimesh, repairs: list[str]) -> Manifold | None:
    """Return the union of closed pieces that share edges and parts of faces; None where a piece is not closed.

    Pieces are joined by edges of exactly two faces: at an edge that two boxes share there are four.
    """
    count = len(mesh.faces)
    pieces = trimesh.graph.connected_components(mesh.face_adjacency, nodes=np.arange(count), min_len=1)
    if not 1 < len(pieces) <= MOST_PIECES:
        return None
    solids = []
    for piece in pieces:
        solid = _as_solid(trimesh.Trimesh(mesh.vertices, mesh.faces[np.sort(piece)], process=False))
        if solid is None:
            return None
        solids.append(solid)
    repairs.append(f"united {len(pieces)} closed pieces")
    return Manifold.batch_boolean(solids, OpType.Add)


def _remeshed(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Zero level of the distance to the surface, signed by the winding number, on a grid."""
    from skimage.measure import marching_cubes

    pitch = float(mesh.extents.max()) / CELLS
    low = mesh.bounds[0] - 2 * pitch
    shape = np.ceil(mesh.extents / pitch).astype(int) + 5
    grid = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), axis=-1).reshape(-1, 3) * pitch + low
    # dense samples: the distance to them is that to the surface within a small part of a cell
    count = int(min(4e5, 50 * mesh.area / pitch**2))
    samples, faces = trimesh.sample.sample_surface(mesh, count, seed=0)[:2]
    normals = mesh.face_normals[faces]
    # the bound spares it the points in the middle, which are as far from half of the samples
    found: Any = KDTree(samples).query(grid, k=NEIGHBOURS, distance_upper_bound=4 * pitch)
    distance, nearest = np.minimum(found[0], 4 * pitch), np.minimum(found[1], count - 1)
    few = slice(None, None, max(1, count // WINDING_SAMPLES))
    scale = 1 / pitch  # single precision likes numbers near 1
    middle = grid.mean(axis=0)
    inside = winding_number(
        (grid - middle) * scale, (samples[few] - middle) * scale, normals[few], mesh.area * scale**2
    )
    outwards = 1.0 if np.abs(inside.max()) >= np.abs(inside.min()) else -1.0
    inside *= outwards
    # nearer than the samples' spacing the surface itself tells
    near = distance[:, 0] < min(2 * np.sqrt(mesh.area / len(samples[few])), 3 * pitch)
    height = np.einsum("nki,nki->nk", grid[near, None] - samples[nearest[near]], normals[nearest[near]]).mean(axis=1)
    inside[near] = height * outwards < 0
    distance = distance[:, 0]
    field = np.where(inside > 0.5, -distance, distance).reshape(shape)
    if field.min() >= 0:
        return trimesh.Trimesh()
    vertices, faces, _, _ = marching_cubes(field, 0.0, spacing=(pitch,) * 3)
    closed = trimesh.Trimesh(vertices + low, faces, process=True)
    bodies = closed.split(only_watertight=True)
    largest = max((abs(body.volume) for body in bodies), default=0.0)
    kept = [body for body in bodies if abs(body.volume) >= CRUMB * largest]
    joined: Any = trimesh.util.concatenate(kept) if kept else closed
    return joined


def winding_number(points: Array, samples: Array, normals: Array, area: float) -> Array:
    """How often a surface, closed or not, runs around points: 1 inside, 0 outside, between them near a hole.

    Each sample stands for its share of the surface, which holds from about two samples' spacing on.

    Args:
        points: (N, 3).
        samples: (S, 3) spread evenly over the surface.
        normals: (S, 3) outward unit normals there.
        area: of the surface.

    Returns:
        (N,)
    """
    at, out = samples.astype(np.float32), normals.astype(np.float32)
    reach = np.einsum("si,si->s", at, out)
    result = np.empty(len(points))
    for start in range(0, len(points), WINDING_CHUNK):
        p = points[start : start + WINDING_CHUNK].astype(np.float32)
        squared = np.maximum((p * p).sum(axis=1)[:, None] + (at * at).sum(axis=1) - 2 * p @ at.T, 1e-12)
        result[start : start + len(p)] = ((reach - p @ out.T) / (squared * np.sqrt(squared))).sum(axis=1)
    return result * area / (4 * np.pi * len(samples))


def _light(solid: Manifold, diagonal: float) -> trimesh.Trimesh:
    """Return the surface of the solid with few faces, closed, within a thousandth or so of its size."""
    for tolerance in TOLERANCES:
        if solid.num_tri() <= FACES:
            break
        lighter = solid.simplify(tolerance * diagonal)
        if abs(lighter.volume() - solid.volume()) > SIMPLIFIED_VOLUME * solid.volume():
            break
        solid = lighter
    return to_mesh(solid)


def _open_edges(mesh: trimesh.Trimesh) -> int:
    return len(trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1))
