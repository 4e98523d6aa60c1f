"""Decompose a closed mesh into convex hulls: one hull if it is close, otherwise hulls of CoACD."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from sapien import physx
from scipy.spatial import ConvexHull, QhullError

from asset_tools.quality.hulls import compute_volume_iou, measure_hull_quality
from asset_tools.solids import mesh_to_solid, solid_to_mesh
from robocas_ms3.assets.cooked_hulls import MAX_SHRINKAGE, MAX_SLENDERNESS, cook_hulls
from robocas_ms3.assets.hulls import center_of_mass, find_box, slenderness
from robocas_ms3.assets.physics import make_convex_shape
from robocas_ms3.core.errors import AssetError

Array = NDArray[np.float64]

GPU_LIMIT = 64  # vertices and faces of a hull on a GPU; PhysX drops more
MAX_VERTICES = 34  # at most 64 triangles; more vertices only if they share flat faces
UNFELT = 0.0007  # m: PhysX drops vertices closer than this to the hull of the others
BEVEL, THIN = 0.001, 8  # m, and fraction (1 / 8) of the thickness; largest bevel that is squared
FLAT, BROAD = 0.0001, 0.5  # m, and fraction of the extents; flat and broad base faces
MAX_HULLS = 32
WANTED_OVERLAP = 0.9  # the smallest number of hulls with this IoU is used
THRESHOLDS = (0.2, 0.12, 0.08, 0.05)  # CoACD's concavity, coarse first
FINE = (0.05, 0.03)  # for hollow objects, whose inside coarse cuts would fill
SMOOTHED = 0.002  # of the diagonal: details removed before CoACD
HOLLOW = 0.5  # volume over that of the convex hull; less is hollow or thin
WANTED_DISTANCE = 0.002  # m, 95th percentile of the distance between a hollow object and its hulls
BOX = 8  # hulls with at most this number of vertices stay unchanged
TRIES = 8  # failed mergers in a row before stopping
LOST_OVERLAP = 0.02  # IoU that merging the hulls of a hollow object may cost
SLIVER = 1e-4  # of the body's volume: smaller parts are dropped
SLENDER = 0.95 * MAX_SLENDERNESS  # slenderness after thickening


@dataclass(frozen=True)
class Decomposition:
    """Convex hulls of a body.

    Attributes:
        hulls: vertices (V, 3) of each hull, m.
        volume_iou: IoU of the body and the union of the hulls.
    """

    hulls: list[Array]
    volume_iou: float


def decompose_mesh(closed: trimesh.Trimesh) -> Decomposition:
    """Decompose a closed mesh into at most 32 convex hulls that PhysX accepts on CPU and GPU.

    The result is deterministic.

    Args:
        closed: watertight mesh, metres.

    Raises:
        AssetError: the mesh is not closed, or CoACD finds no hulls.
    """
    if not closed.is_watertight or closed.volume <= 0:
        found = f"watertight: {closed.is_watertight}, volume {closed.volume:.3g} m3"
        expected = "a watertight mesh with a volume above 0"
        raise AssetError("cannot decompose an open mesh", expected=expected, found=found)
    found = _decompose(closed)
    hulls = [adapt_hull_to_engine(hull) for hull in found.hulls]
    if all(hull is old for hull, old in zip(hulls, found.hulls, strict=True)):
        return found
    return Decomposition(hulls, compute_volume_iou(closed, hulls))


def _decompose(closed: trimesh.Trimesh) -> Decomposition:
    """Return one convex hull if its IoU with the mesh is large, otherwise the merged hulls of CoACD."""
    best: Decomposition | None = None
    if closed.volume / closed.convex_hull.volume >= WANTED_OVERLAP - 0.02:
        hulls = [reduce_hull_vertices(np.asarray(closed.vertices))]
        best = Decomposition(hulls, compute_volume_iou(closed, hulls))
        if best.volume_iou >= WANTED_OVERLAP:
            return best
    hollow, smooth = is_hollow(closed), _smoothed(closed)
    for threshold in FINE if hollow else THRESHOLDS:
        hulls = _run_coacd(smooth, threshold)
        if not hulls:
            continue
        found = Decomposition(hulls, compute_volume_iou(closed, hulls))
        if _good_enough(closed, found, hollow):
            return _merged(closed, found, hollow)
        if best is None or found.volume_iou > best.volume_iou + 0.01:
            best = found
    if best is None:
        raise AssetError("the convex decomposition found no hulls", fix="Check that the mesh has a volume.")
    return best


def reduce_hull_vertices(points: Array, *, bevel: float = BEVEL) -> Array:
    """Return the few vertices (V, 3) of a simplified convex hull with the same volume.

    PhysX keeps few vertices of a hull. It would keep single corners of a small bevel around a base, on which a bottle
    rocks. Therefore small bevels around broad faces across x, y or z are first replaced by sharp edges. Then the
    function starts with a few extreme vertices and repeatedly adds the vertex farthest outside of their hull, until
    all vertices are within 0.7 mm. It keeps at most 34 vertices, or 64 if the hull has at most 64 flat faces. Finally
    the vertices are scaled about the centre of mass to the volume of the original hull.

    Args:
        points: (P, 3) points, m.
        bevel: largest bevel that is replaced by a sharp edge, m; 0 for parts that fit each other.
    """
    points = _without_bevels(points, bevel)
    hull = ConvexHull(points)
    vertices = points[hull.vertices]
    if len(vertices) <= BOX:
        return vertices
    directions = np.concatenate([np.eye(3), -np.eye(3), np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T])
    chosen = list(dict.fromkeys(np.argmax(vertices @ directions.T, axis=0).tolist()))
    while len(chosen) < min(GPU_LIMIT, len(vertices)):
        outside = _outside(vertices, vertices[chosen])
        farthest = int(outside.argmax())
        if outside[farthest] <= UNFELT:
            break
        chosen.append(farthest)
    unfelt = min(UNFELT, hull.volume / hull.area / 2)  # a quarter of the thickness of a thin plate
    for index in list(chosen):  # the initial vertices may be negligible
        others = [other for other in chosen if other != index]
        if _outside(vertices[[index]], vertices[others])[0] <= unfelt:
            chosen = others
    if len(chosen) > MAX_VERTICES and count_flat_faces(vertices[chosen]) > GPU_LIMIT:
        chosen = chosen[:MAX_VERTICES]
    kept = vertices[chosen]
    center = center_of_mass(kept)
    return center + (kept - center) * np.cbrt(hull.volume / ConvexHull(kept).volume)


def adapt_hull_to_engine(points: Array) -> Array:
    """Return the vertices (V, 3) of a convex hull that PhysX can build on CPU and GPU.

    A box is returned unchanged. A hull that is too slender is stretched along its thin axes. If PhysX would shrink the
    hull too much, the vertices of PhysX's own hull are returned. If PhysX rejects the hull, the corners of its oriented
    bounding box are returned.

    Args:
        points: (P, 3) vertices of the hull, m.
    """
    if find_box(points) is not None:
        return points
    center = center_of_mass(points)
    axes = np.linalg.svd(points - points.mean(axis=0))[2]
    local = (points - center) @ axes.T
    depths = np.abs(local).max(axis=0)
    thin = depths < depths.max() / 10
    while (excess := slenderness(points) / SLENDER) > 1:
        local[:, thin] *= max(excess, 1.01)
        points = center + local @ axes
    try:
        if cook_hulls([points])[0].shrinkage > MAX_SHRINKAGE:
            points = np.array(make_convex_shape(points, physx.PhysxMaterial(1, 1, 0)).vertices, dtype=float)
    except RuntimeError:
        to_box, extents = trimesh.bounds.oriented_bounds(points)
        points = trimesh.creation.box(extents, transform=np.linalg.inv(to_box)).vertices
    return points


def _without_bevels(points: Array, bevel: float) -> Array:
    """Move points (P, 3) that are close to a broad face across x, y or z into the plane of this face.

    Args:
        points: (P, 3) points, m.
        bevel: largest distance that counts as close, m.
    """
    squared, extents = np.array(points), np.ptp(points, axis=0)
    for axis in range(3):
        for extreme in (points[:, axis].min(), points[:, axis].max()):
            below = np.abs(points[:, axis] - extreme)
            face = np.ptp(points[below <= FLAT], axis=0)
            if np.delete(face >= BROAD * extents, axis).all():
                squared[below <= min(bevel, extents[axis] / THIN), axis] = extreme
    return squared


def _outside(points: Array, corners: Array) -> Array:
    """Return the signed distances (P,) of points (P, 3) from the convex hull of corners (V, 3), m.

    The distances are negative inside.

    If the corners are coplanar, the result is the distance from the plane of the corners plus 1 m.
    """
    try:
        planes = ConvexHull(corners).equations
    except QhullError:
        middle = corners.mean(axis=0)
        _, sizes, axes = np.linalg.svd(corners - middle)
        axes = axes[: np.count_nonzero(sizes[:2] > 1e-6 * sizes[0])]
        apart = points - middle
        return 1 + np.linalg.norm(apart - apart @ axes.T @ axes, axis=1)
    return (points @ planes[:, :3].T + planes[:, 3]).max(axis=1)


def count_flat_faces(points: Array) -> int:
    """Count the faces of the convex hull of points (V, 3); coplanar triangles are one face."""
    return len(np.unique(np.round(ConvexHull(points).equations, 6), axis=0))


def is_hollow(closed: trimesh.Trimesh) -> bool:
    """Return whether a body is hollow, or thin and bent: the body fills less than half of its convex hull."""
    return bool(closed.volume < HOLLOW * closed.convex_hull.volume)


def _good_enough(closed: trimesh.Trimesh, found: Decomposition, hollow: bool, least: float = 0.0) -> bool:
    if not hollow:
        return found.volume_iou >= WANTED_OVERLAP
    return found.volume_iou >= least and measure_hull_quality(closed, found.hulls).surface_p95 <= WANTED_DISTANCE


def _merged(closed: trimesh.Trimesh, found: Decomposition, hollow: bool) -> Decomposition:
    """Merge pairs of hulls as long as the decomposition stays good enough.

    Pairs that add little volume come first.
    """
    least = found.volume_iou - LOST_OVERLAP
    hulls, volumes = dict(enumerate(found.hulls)), {i: ConvexHull(hull).volume for i, hull in enumerate(found.hulls)}

    def compute_added_volume(i: int, j: int) -> float:
        return ConvexHull(np.concatenate([hulls[i], hulls[j]])).volume - volumes[i] - volumes[j]

    costs = {(i, j): compute_added_volume(i, j) for i in hulls for j in hulls if i < j}
    tries = 0
    while costs and tries < TRIES:
        i, j = min(costs, key=lambda pair: (costs[pair], pair))
        kept = {k: hull for k, hull in hulls.items() if k not in (i, j)}
        new = max(volumes) + 1
        kept[new] = reduce_hull_vertices(np.concatenate([hulls[i], hulls[j]]))
        fewer = Decomposition(list(kept.values()), compute_volume_iou(closed, list(kept.values())))
        if not _good_enough(closed, fewer, hollow, least):
            tries += 1
            del costs[i, j]
            continue
        found, hulls, volumes[new], tries = fewer, kept, float(ConvexHull(kept[new]).volume), 0
        costs = {pair: cost for pair, cost in costs.items() if not {i, j} & set(pair)}
        costs |= {(k, new): compute_added_volume(k, new) for k in kept if k != new}
    return found


def _smoothed(closed: trimesh.Trimesh) -> trimesh.Trimesh:
    solid = mesh_to_solid(closed)
    if solid is None:
        return closed
    return solid_to_mesh(solid.simplify(SMOOTHED * float(np.linalg.norm(closed.extents))))


def _run_coacd(body: trimesh.Trimesh, threshold: float) -> list[Array]:
    import coacd

    coacd.set_log_level("error")
    least = SLIVER * float(body.volume)
    vertices: Any = np.asarray(body.vertices)
    faces: Any = np.asarray(body.faces)
    parts = coacd.run_coacd(
        coacd.Mesh(vertices, faces),
        threshold=threshold,
        max_convex_hull=MAX_HULLS,
        preprocess_mode="off",  # preprocessing thickens thin walls; the input is closed already
        resolution=500,
        mcts_iterations=20,
        mcts_nodes=20,
        mcts_max_depth=1,  # merging corrects greedy cuts ten times faster than a deeper search
        seed=0,
    )
    return [
        reduce_hull_vertices(points)
        for points in (np.array(vertices) for vertices, _ in parts)
        if _volume(points) > least
    ]


def _volume(points: Array) -> float:
    """Return the volume of the convex hull of points (V, 3); 0 if they are coplanar."""
    try:
        return float(ConvexHull(points).volume)
    except (QhullError, ValueError):
        return 0.0
