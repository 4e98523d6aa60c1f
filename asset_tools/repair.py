"""Close scans: convert the surface of a scan to a watertight solid for volume, hulls and grasps."""

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
from asset_tools.solids import mesh_to_solid, solid_to_mesh
from robocas_ms3.core.errors import AssetError

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

FILLED = 0.35  # largest filled fraction of the surface
HOPELESS = 0.4  # fraction of open edges above which a scan is not remeshed
LEAST_VOLUME = 0.01  # of the convex hull's volume; less is a sheet, not a body
FOIL = 1e-5  # thickness over diagonal; below, the body is a sheet
FACES = 5000  # maximum for the solid
SIMPLIFIED_VOLUME = 0.05  # largest relative change of the volume by simplification; more removes thin parts
TOLERANCES = (0.0005, 0.001, 0.0015, 0.002, 0.003)  # of the diagonal, tried in this order
LOST = 0.03  # of the diagonal: largest change of the bounding box
MOST_PIECES = 1000
CRUMB = 0.001  # of the largest body's volume; smaller bodies after remeshing are noise
CELLS = 64  # of the remeshing grid along the longest side
WINDING_SAMPLES, WINDING_CHUNK = 4000, 2048
NEIGHBOURS = 6  # samples that determine the side of the surface for a close point


@dataclass(frozen=True)
class ClosedScan:
    """A scan and a watertight mesh of its body.

    Attributes:
        mesh: watertight mesh with outward faces, in the frame and unit of the scan.
        scan: visual mesh with outward faces, without scanner dirt and inner shells, in the same frame and unit.
        repairs: one note per repair.
    """

    mesh: trimesh.Trimesh
    scan: trimesh.Trimesh
    repairs: tuple[str, ...]


def close_scan(scan: trimesh.Trimesh) -> ClosedScan:
    """Convert a scan to a watertight solid.

    The function merges vertices, removes scanner dirt, orients the faces and fills holes. If the mesh is still open,
    it is remeshed. Shells inside the outer surface, as in the scan of a transparent can, are dropped.

    Args:
        scan: mesh in any unit; UV seams are allowed.

    Raises:
        AssetError: the scan is a sheet without volume, or cannot be closed.
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
            "cannot convert the mesh to a solid",
            expected=f"only small holes, and a volume of at least {LEAST_VOLUME:.0%} of the convex hull",
            found=f"{_open_edges(mesh)} open edges of {len(mesh.edges_unique)}, in {mesh.body_count} pieces",
            fix="Repair the scan, or skip it.",
        )
    closed = _light(solid, diagonal)
    lost = float(np.abs(closed.bounds - shown.bounds).max())
    if lost > LOST * diagonal:
        raise AssetError(
            "the closed mesh lacks a part of the scan",
            expected=f"a bounding box that changes by at most {LOST:.0%} of its diagonal",
            found=f"a change of {lost / diagonal:.0%}",
            fix="Repair the mesh: join its parts to one closed surface.",
        )
    return ClosedScan(closed, shown, tuple(repairs))


def _hull_volume(mesh: trimesh.Trimesh) -> float:
    """Return the volume of the convex hull of a mesh; 0 for a flat mesh."""
    try:
        return float(mesh.convex_hull.volume)
    except QhullError:
        return 0.0


def _filled(
    mesh: trimesh.Trimesh, shown: trimesh.Trimesh, repairs: list[str]
) -> tuple[trimesh.Trimesh, trimesh.Trimesh]:
    """Fill the holes of a mesh with triangles around the centre of each hole.

    Args:
        mesh: mesh with vertices merged by position.
        shown: visual mesh with equal faces in equal order.
        repairs: list to which the function appends a note.

    Returns:
        Both meshes with filled holes; the input meshes if two holes share a vertex.

    Raises:
        AssetError: the holes are larger than 35 % of the surface.
    """
    rim_edges = trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1)
    edges = mesh.edges[rim_edges]
    following = {int(a): int(b) for b, a in edges}  # the fill traverses the rim in the opposite direction
    if len(following) < len(edges) or not following:
        return mesh, shown  # holes that share a vertex, or edges of more than two faces: remeshed instead
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
            "the holes of the mesh are too large",
            expected=f"holes of at most {FILLED:.0%} of the surface",
            found=f"{area / mesh.area:.0%}",
            fix="Scan the object from all sides, or skip the scan.",
        )
    repairs.append(f"filled {holes} hole{'s' if holes > 1 else ''}")
    filled = trimesh.Trimesh(np.concatenate(vertices), np.concatenate(faces), process=False)
    face, corner = np.asarray(mesh.edges_face)[rim_edges], np.asarray(rim_edges, np.int64) % 3
    return filled, _patched(shown, face, corner, np.array([middles[int(a)] for a in edges[:, 0]]))


def _patched(shown: trimesh.Trimesh, face: Ints, corner: Ints, middles: Array) -> trimesh.Trimesh:
    """Fill holes with triangles from each edge of a rim to the centre, in the colours of the edges.

    Args:
        shown: textured or coloured mesh.
        face: (E,) index of the face at each edge of a rim.
        corner: (E,) index 0, 1 or 2 of the corner of this face at which the edge starts.
        middles: (E, 3) centre of the hole at each edge.
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
    """Convert a mesh to a solid with outward faces.

    Return None if the mesh is not closed or has no volume.
    """
    if not mesh.is_watertight:
        return None
    if mesh.volume < 0:
        mesh.invert()
    solid = mesh_to_solid(mesh)
    if solid is None or solid.volume() <= 0:
        return None
    bodies = [body for body in solid.decompose() if body.volume() > 0]
    return Manifold.batch_boolean(bodies, OpType.Add)  # otherwise overlaps would count twice


def _union_of_pieces(mesh: trimesh.Trimesh, repairs: list[str]) -> Manifold | None:
    """Return the union of the closed pieces of a mesh, which may touch; None if a piece is not closed.

    Only edges of exactly two faces connect the faces of a piece. An edge at which two boxes touch has four faces.
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
    """Return a closed mesh around an open surface.

    The function computes the distance to the surface on a grid. The winding number gives the sign of the distance. The
    result is the mesh of the zero level, from marching cubes.
    """
    from skimage.measure import marching_cubes

    pitch = float(mesh.extents.max()) / CELLS
    low = mesh.bounds[0] - 2 * pitch
    shape = np.ceil(mesh.extents / pitch).astype(int) + 5
    grid = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), axis=-1).reshape(-1, 3) * pitch + low
    # dense samples approximate the distance to the surface to a small part of a cell
    count = int(min(4e5, 50 * mesh.area / pitch**2))
    samples, faces = trimesh.sample.sample_surface(mesh, count, seed=0)[:2]
    normals = mesh.face_normals[faces]
    # the bound spares it the points in the middle, which are as far from half of the samples
    found: Any = KDTree(samples).query(grid, k=NEIGHBOURS, distance_upper_bound=4 * pitch)
    distance, nearest = np.minimum(found[0], 4 * pitch), np.minimum(found[1], count - 1)
    few = slice(None, None, max(1, count // WINDING_SAMPLES))
    scale = 1 / pitch  # numbers near 1 keep single precision accurate
    middle = grid.mean(axis=0)
    inside = compute_winding_numbers(
        (grid - middle) * scale, (samples[few] - middle) * scale, normals[few], mesh.area * scale**2
    )
    outwards = 1.0 if np.abs(inside.max()) >= np.abs(inside.min()) else -1.0
    inside *= outwards
    # closer than the samples' spacing, the normals of near samples determine the side
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


def compute_winding_numbers(points: Array, samples: Array, normals: Array, area: float) -> Array:
    """Return the winding number (N,) of a surface at points: 1 inside, 0 outside, between near a hole.

    Samples approximate the surface. The result is accurate at points farther from the surface than twice the distance
    between neighbouring samples.

    Args:
        points: (N, 3) query points.
        samples: (S, 3) points spread evenly over the surface.
        normals: (S, 3) outward unit normals of the samples.
        area: area of the surface.
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
    """Return the surface of a solid, simplified to at most 5000 faces if this keeps 95 % of the volume."""
    for tolerance in TOLERANCES:
        if solid.num_tri() <= FACES:
            break
        lighter = solid.simplify(tolerance * diagonal)
        if abs(lighter.volume() - solid.volume()) > SIMPLIFIED_VOLUME * solid.volume():
            break
        solid = lighter
    return solid_to_mesh(solid)


def _open_edges(mesh: trimesh.Trimesh) -> int:
    return len(trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1))
