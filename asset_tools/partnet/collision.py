"""Decompose each part of furniture into convex pieces, so that drawers and compartments stay open."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.spatial import ConvexHull, KDTree, QhullError
from shapely import unary_union
from shapely.geometry import MultiPolygon, Polygon

from asset_tools.decompose import reduce_hull_vertices
from asset_tools.repair import close_scan
from robocas_ms3.assets.cooked_hulls import MAX_SLENDERNESS
from robocas_ms3.assets.hulls import find_box, slenderness
from robocas_ms3.core.errors import AssetError

Array = np.ndarray

TOLERANCE, FINE = (
    0.02,
    0.005,
)  # m, 90th percentile between hull and surface; FINE for handles, behind which fingers reach
FARTHEST = 2.25  # times the tolerance, maximum distance
BOARD = 0.08  # m: thinner parts become their hull, unless they have a through hole
SMALL = 0.08  # m: smaller parts become their hull
TINY = 0.015  # m: smaller parts are dropped
SHEET = 0.01  # m, thickness given to sheets: downward, so that the visible surface stays, or else inward
FLAT = 0.0005  # m
LEVEL = 0.9  # of a normal's z
FILLED = 0.1  # added fraction of the surface by closing; more would be a lid on an open part
LARGEST_FACETS = 40  # maximum number of walls of an open shell
SLENDER = 0.95 * MAX_SLENDERNESS
MOST = 40  # maximum number of pieces of a link
SAMPLES = 300
DENSE = 1000  # triangles; for more, distances are measured to sampled points
CUTS, STEPS, DEPTH = 6, 5, 4  # tried planes per axis: at faces and evenly spaced; maximum depth of successive cuts


@dataclass(frozen=True)
class CollisionPart:
    """A part of furniture, as PartNet divides it.

    Attributes:
        name: name of the part, such as ``drawer_side-23``.
        meshes: triangles (F, 3, 3) of each mesh of the part, m.
    """

    name: str
    meshes: list[Array]


def make_collision_pieces(parts: Sequence[CollisionPart], middle: Array) -> list[Array]:
    """Decompose the parts of a link into at most 40 convex pieces.

    Return the corners (V, 3) of each piece, m.

    A part that nearly fills its convex hull becomes one piece. Another part is split into its meshes, and each mesh
    into its connected components. A component that is an open shell is split into walls. Other components are cut by
    the planes that reduce the volume of the hulls most. For furniture made of boards, such cuts are more exact and
    faster than a general convex decomposition.

    Args:
        parts: parts of the link.
        middle: (3,) centre of the furniture, m; vertical sheets get their thickness towards this point.

    Raises:
        AssetError: all parts are too small.
    """
    found: list[Array] = []
    for part in parts:
        fine = "handle" in part.name or "knob" in part.name
        # slender parts other than handles do not support objects
        found += [piece for piece in _split(part.meshes, fine, middle) if _size(piece, 0 if fine else 1) >= TINY]
    hulls = [reduce_hull_vertices(piece, bevel=0) for piece in found]
    hulls = _without_hidden(hulls)
    if not hulls:
        where, expected = ", ".join(part.name for part in parts)[:80], f"a part of at least {TINY * 1000:g} mm"
        fix = "Set `scale` in the annotation, or fix the joint of these parts."
        raise AssetError("no collision shape", where=where, expected=expected, found="only smaller parts", fix=fix)
    if len(hulls) > MOST:
        order = np.argsort([-np.ptp(hull, axis=0).max() for hull in hulls], kind="stable")[:MOST]
        hulls = [hulls[index] for index in sorted(order)]
    return hulls


def split_slender_hull(hull: Array) -> list[Array]:
    """Return a hull as one or two hulls that are not too slender for PhysX on a GPU.

    A hull that is too slender is replaced by its two halves, or by its oriented bounding box.

    Args:
        hull: (V, 3) corners, m.
    """
    if _sturdy(hull):
        return [hull]
    axis = int(np.ptp(hull, axis=0).argmax())
    middle = float(hull[:, axis].min() + hull[:, axis].max()) / 2
    corners = hull[ConvexHull(hull).simplices]
    halves = [reduce_hull_vertices(_half(corners, axis, middle, side).reshape(-1, 3), bevel=0) for side in (1.0, -1.0)]
    if all(_sturdy(half) for half in halves):
        return halves
    to_middle, extents = trimesh.bounds.oriented_bounds(hull)
    return [np.asarray(trimesh.creation.box(extents, np.linalg.inv(to_middle)).vertices)]


def _sturdy(hull: Array) -> bool:
    return find_box(hull) is not None or slenderness(hull) < SLENDER


def _size(points: Array, rank: int) -> float:
    """Return the longest (``rank`` 0), middle (1) or shortest (2) extent of points (P, 3), m."""
    return float(np.sort(np.ptp(points, axis=0))[2 - rank])


def _split(meshes: Sequence[Array], fine: bool, middle: Array) -> list[Array]:
    points = np.concatenate(meshes).reshape(-1, 3)
    flat = _flat_hull(points, middle)
    if flat is not None:
        return [flat]
    if _fits(np.concatenate(meshes), fine):
        return [points]
    if len(meshes) > 1:
        return [piece for mesh in meshes for piece in _split([mesh], fine, middle)]
    body = _welded(meshes[0])
    components = trimesh.graph.connected_components(body.face_adjacency, nodes=np.arange(len(body.faces)), min_len=1)
    if len(components) > 1:
        return [piece for one in components for piece in _split([body.triangles[np.sort(one)]], fine, middle)]
    return _walls(body) if _is_shell(body) else _cut(body.triangles, fine, DEPTH)


def _is_shell(body: trimesh.Trimesh) -> bool:
    """Return whether a mesh is an open shell: closing it would add more than 10 % to its area."""
    if body.is_watertight:
        return False
    try:
        return close_scan(body).mesh.area > (1 + FILLED) * body.area
    except AssetError:
        return True


def _cut(triangles: Array, fine: bool, depth: int) -> list[Array]:
    """Cut a closed mesh by planes across x, y or z into nearly convex pieces.

    Return the points (P, 3) of each piece.

    Args:
        triangles: (F, 3, 3) triangles, m.
        fine: whether the mesh is a handle, which needs small tolerances.
        depth: maximum number of successive cuts.
    """
    points = triangles.reshape(-1, 3)
    size = np.ptp(points, axis=0)
    if depth == 0 or size.max() <= TINY or _fits(triangles, True, TINY if fine else SMALL):
        return [points]
    best, halves = np.inf, []
    for axis, place in _places(triangles, size > (0 if fine else BOARD / 2)):
        found = [_half(triangles, axis, place, side) for side in (1.0, -1.0)]
        volume = sum(_hull_volume(half) for half in found)
        # next to an opening the first cut does not reduce the volume: the first of equal cuts is used
        if min(map(len, found)) and volume < 0.98 * best:
            best, halves = volume, found
    if not halves:
        return [points]
    pieces = []
    for half in halves:
        body = _welded(half)
        for one in trimesh.graph.connected_components(body.face_adjacency, nodes=np.arange(len(body.faces)), min_len=1):
            part = body.triangles[np.sort(one)]
            if np.ptp(part.reshape(-1, 3), axis=0).min() > FLAT and _hull_volume(part) > 0:
                pieces += _cut(part, fine, depth - 1)
    return pieces


def _places(triangles: Array, across: Array) -> list[tuple[int, float]]:
    """Return axis and position of each cut to try: at the largest faces, then at even steps.

    Args:
        triangles: (F, 3, 3) triangles, m.
        across: (3,) whether to cut across x, y and z; False for the thin side of a board.
    """
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    level = np.abs(cross) > 0.99 * np.linalg.norm(cross, axis=1, keepdims=True)
    faces, steps = [], []
    for axis in np.flatnonzero(across).tolist():
        low, high = triangles[..., axis].min(), triangles[..., axis].max()
        places, which = np.unique(np.round(triangles[:, :, axis].mean(axis=1), 4), return_inverse=True)
        areas = np.bincount(which, np.abs(cross[:, axis]) * level[:, axis])
        inside = np.flatnonzero((places > low + FLAT) & (places < high - FLAT) & (areas > 0))
        order = inside[np.argsort(-np.round(areas[inside], 9), kind="stable")][:CUTS]
        faces += [(-round(float(areas[one]), 9), axis, float(places[one])) for one in order]
        steps += [(axis, float(place)) for place in np.linspace(low, high, STEPS + 2)[1:-1]]
    return [(axis, place) for _, axis, place in sorted(faces)] + steps


def _half(triangles: Array, axis: int, place: float, side: float) -> Array:
    points, faces = triangles.reshape(-1, 3), np.arange(len(triangles) * 3).reshape(-1, 3)
    points, faces = trimesh.intersections.slice_faces_plane(
        points, faces, side * np.eye(3)[axis], place * np.eye(3)[axis]
    )[:2]
    return np.asarray(points)[np.asarray(faces)].reshape(-1, 3, 3)


def _hull_volume(triangles: Array) -> float:
    try:
        return float(ConvexHull(triangles.reshape(-1, 3)).volume)
    except (QhullError, ValueError):
        return 0.0


def _welded(triangles: Array) -> trimesh.Trimesh:
    body = trimesh.Trimesh(triangles.reshape(-1, 3), np.arange(len(triangles) * 3).reshape(-1, 3), process=False)
    body.merge_vertices(digits_vertex=5)
    body.update_faces(body.nondegenerate_faces() & body.unique_faces())
    body.remove_unreferenced_vertices()
    return body


def _flat_hull(points: Array, middle: Array) -> Array | None:
    """Return points (2 P, 3) of a slab for coplanar points (P, 3); None if the points are not coplanar.

    Args:
        points: (P, 3) points, m.
        middle: (3,) centre of the furniture, towards which a vertical sheet gets its thickness.
    """
    center = points.mean(axis=0)
    spread = np.linalg.svd(points - center, full_matrices=False)
    normal = spread[2][-1]
    if np.ptp(points @ normal) > FLAT:
        return None
    return np.concatenate([points, points + _thickness(normal, middle - center)])


def _thickness(normal: Array, inward: Array) -> Array:
    """Return the vector (3,) in m from a sheet to the other side of its slab: down, or to the inside."""
    level = abs(normal[2]) > LEVEL
    return normal * (SHEET if (-normal[2] if level else normal @ inward) > 0 else -SHEET)


def _fits(triangles: Array, fine: bool, small: float = SMALL) -> bool:
    """Return whether a part is small, or close enough to its convex hull, to be replaced by the hull.

    Args:
        triangles: (F, 3, 3) triangles of the part, m.
        fine: whether to use the small tolerance for handles.
        small: extent below which a part always counts, m.
    """
    points = triangles.reshape(-1, 3)
    if np.ptp(points, axis=0).max() <= small:
        return True
    hull = ConvexHull(points)
    body = _welded(triangles)
    outside = trimesh.Trimesh(points, hull.simplices, process=False)
    spots = trimesh.sample.sample_surface(outside, SAMPLES, seed=0)[0]
    gaps = _distances(body, spots)
    tolerance = FINE if fine else TOLERANCE
    if np.percentile(gaps, 90) <= tolerance and gaps.max() <= FARTHEST * tolerance:
        return True
    if fine:
        return False
    thickness = float(min(trimesh.bounds.oriented_bounds(outside)[1]))
    return thickness <= BOARD and bool(gaps.max() <= 1.05 * thickness)


def _distances(body: trimesh.Trimesh, points: Array) -> Array:
    if len(body.faces) <= DENSE:
        return trimesh.proximity.closest_point(body, points)[1]
    places = trimesh.sample.sample_surface(body, 20_000, seed=0)[0]
    return KDTree(np.concatenate([places, body.vertices])).query(points)[0]


def _walls(body: trimesh.Trimesh) -> list[Array]:
    """Return the points (P, 3) of a slab for each flat face of an open shell; slabs are on the inside."""
    groups = [np.asarray(group) for group in body.facets]
    single = np.setdiff1d(np.arange(len(body.faces)), np.concatenate(groups) if groups else [])
    groups += [np.array([face]) for face in single]
    groups.sort(key=lambda group: -body.area_faces[group].sum())
    middle = body.bounds.mean(axis=0)
    slabs = []
    for group in groups[:LARGEST_FACETS]:
        normal = body.face_normals[group[0]]
        across = np.linalg.svd(normal[None])[2][1:]
        origin = body.triangles[group[0], 0]
        grown = _thickness(normal, middle - origin)
        for outline in _convex_outlines((body.triangles[group] - origin) @ across.T):
            face = origin + outline @ across
            slabs.append(np.concatenate([face, face + grown]))
    return slabs


def _convex_outlines(triangles: Array) -> list[Array]:
    """Return convex polygons (V, 2) that cover coplanar triangles (F, 3, 2).

    Neighbours with a convex union are joined.
    """
    shapes = [Polygon(triangle) for triangle in triangles]
    union = unary_union(shapes)
    whole = [one for one in (union.geoms if isinstance(union, MultiPolygon) else [union]) if isinstance(one, Polygon)]
    if all(one.area >= 0.97 * one.convex_hull.area for one in whole):
        shapes = whole
    joined = True
    while joined:
        joined = False
        for i in range(len(shapes)):
            for j in range(i + 1, len(shapes)):
                both = shapes[i].union(shapes[j])
                if isinstance(both, Polygon) and both.area >= 0.99 * both.convex_hull.area:
                    shapes[i] = both
                    del shapes[j]
                    joined = True
                    break
            if joined:
                break
    hulls = [shape.convex_hull for shape in shapes if shape.area > TINY**2]
    return [np.array(hull.exterior.coords)[:-1] for hull in hulls if isinstance(hull, Polygon)]


def _without_hidden(hulls: list[Array]) -> list[Array]:
    """Return the hulls that are not completely inside another hull."""
    planes = [ConvexHull(hull).equations for hull in hulls]
    sizes = [ConvexHull(hull).volume for hull in hulls]
    kept = []
    for index, hull in enumerate(hulls):
        inside = any(
            other != index
            and (sizes[other], other) > (sizes[index], index)
            and (hull @ planes[other][:, :3].T + planes[other][:, 3]).max() < 1e-6
            for other in range(len(hulls))
        )
        if not inside:
            kept.append(hull)
    return kept
