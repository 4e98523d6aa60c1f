"""How well convex hulls stand for the closed mesh they were made from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from manifold3d import Manifold, OpType
from scipy.spatial import KDTree

from asset_tools.decompose import volume_iou
from asset_tools.grasps import surface_samples

Array = np.ndarray

# m. A surface that is off by e all over changes the overlap by about e A / V = 2 e / t, t = 2 V / A being the mean
# thickness: below 1 cm a millimetre, which no grasp feels, costs the 0.2 that compact objects may lose.
THIN = 0.010
SAMPLES = 4000  # points from which distances are taken, on each surface
TARGETS = 20000  # points on the other surface, to find the triangles near by
NEAREST = 4


@dataclass(frozen=True)
class HullQuality:
    """What was measured of an object's hulls.

    Attributes:
        compact: False: thin or hollow, so to be judged by ``surface_p95`` and not by ``volume_iou``.
        hull_count: how many.
        hull_vertices: of the largest.
        volume_iou: overlap of the union of the hulls with the closed mesh.
        surface_p95: 95th percentile of the distances from either surface to the other, m; the larger of both ways.
    """

    compact: bool
    hull_count: int
    hull_vertices: int
    volume_iou: float
    surface_p95: float


def hull_quality(closed: trimesh.Trimesh, hulls: list[Array], *, hollow: bool = False) -> HullQuality:
    """Measure hulls against the body they were made from. The same input gives the same numbers.

    Args:
        closed: watertight, m.
        hulls: (V, 3) vertices each, in its frame.
        hollow: a container, to be judged by distance whatever the thickness of its walls.

    Raises:
        AssetError: the mesh is no solid.
    """
    overlap = volume_iou(closed, hulls)
    union = Manifold.batch_boolean([Manifold.hull_points(hull) for hull in hulls], OpType.Add).to_mesh()
    surface = trimesh.Trimesh(np.asarray(union.vert_properties)[:, :3], np.asarray(union.tri_verts), process=False)
    return HullQuality(
        compact=not hollow and mean_thickness(closed) >= THIN,
        hull_count=len(hulls),
        hull_vertices=max(len(hull) for hull in hulls),
        volume_iou=overlap,
        surface_p95=max(_distance_p95(closed, surface), _distance_p95(surface, closed)),
    )


def mean_thickness(closed: trimesh.Trimesh) -> float:
    """2 V / A in m: the thickness of a plate; half the diameter of a rod, a third of that of a ball."""
    return float(2 * closed.volume / closed.area)


def _distance_p95(source: trimesh.Trimesh, target: trimesh.Trimesh) -> float:
    """95th percentile of the distances from one surface to the other: to the triangles of the nearest samples."""
    points = surface_samples(source, SAMPLES, np.random.default_rng(0))[0]
    samples, faces = surface_samples(target, TARGETS, np.random.default_rng(0))
    nearest = faces[KDTree(samples).query(points, k=NEAREST)[1]]
    starts = np.repeat(points, NEAREST, axis=0)
    ends = trimesh.triangles.closest_point(target.triangles[nearest.ravel()], starts)
    distances = np.linalg.norm(ends - starts, axis=1).reshape(-1, NEAREST).min(axis=1)
    return float(np.percentile(distances, 95))
