"""Measure how well convex hulls approximate the closed source mesh."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from manifold3d import Manifold, OpType
from scipy.spatial import KDTree
from trimesh.ray.ray_pyembree import RayMeshIntersector

from asset_tools.grasps import surface_samples
from asset_tools.solids import to_solid
from robocas_ms3.core.errors import AssetError

Array = np.ndarray

# m. An offset e of the whole surface changes the overlap by about e A / V = 2 e / t with mean thickness t = 2 V / A.
# Below 1 cm, an offset of 1 mm, which is irrelevant for grasps, costs 0.2, the tolerance of compact objects.
THIN = 0.010
SAMPLES = 4000  # query points on each surface
TARGETS = 20000  # points on the other surface, for finding close triangles
NEAREST = 4
SLIT = 0.001  # m; narrower slits are ignored: they are cutting planes of the decomposition


@dataclass(frozen=True)
class HullQuality:
    """Quality of an object's hulls.

    Attributes:
        compact: False: thin or hollow; check ``surface_p95`` instead of ``volume_iou``.
        hull_count: number of hulls.
        hull_vertices: number of vertices of the largest hull.
        volume_iou: overlap of the union of the hulls with the closed mesh.
        surface_p95: 95th percentile of the distances from either surface to the other, m; the larger of both ways.
    """

    compact: bool
    hull_count: int
    hull_vertices: int
    volume_iou: float
    surface_p95: float


def hull_quality(closed: trimesh.Trimesh, hulls: list[Array], *, hollow: bool = False) -> HullQuality:
    """Compare hulls with their source mesh; deterministic.

    Args:
        closed: watertight, m.
        hulls: (V, 3) vertices each, in its frame.
        hollow: whether the object is a container, which is checked by distance for any wall thickness.

    Raises:
        AssetError: the mesh is not a solid.
    """
    overlap = volume_iou(closed, hulls)
    union = _union(hulls).to_mesh()
    surface = trimesh.Trimesh(np.asarray(union.vert_properties)[:, :3], np.asarray(union.tri_verts), process=False)
    return HullQuality(
        compact=not hollow and mean_thickness(closed) >= THIN,
        hull_count=len(hulls),
        hull_vertices=max(len(hull) for hull in hulls),
        volume_iou=overlap,
        surface_p95=max(
            _distance_p95(_samples(closed, SAMPLES)[0], surface),
            _distance_p95(_outside_of_slits(surface, _samples(surface, SAMPLES)), closed),
        ),
    )


def volume_iou(closed: trimesh.Trimesh, hulls: list[Array]) -> float:
    """Return the volume IoU of a body and the union of convex hulls.

    Args:
        closed: watertight mesh.
        hulls: (V, 3) vertices each, in its frame.

    Raises:
        AssetError: the mesh is not a solid.
    """
    solid = to_solid(closed)
    if solid is None:
        raise AssetError("the mesh is not a solid", expected="watertight", fix="Close it first.")
    union = _union(hulls)
    shared = (solid ^ union).volume()
    return float(shared / (solid.volume() + union.volume() - shared))


def _union(hulls: list[Array]) -> Manifold:
    return Manifold.batch_boolean([Manifold.hull_points(hull) for hull in hulls], OpType.Add)


def mean_thickness(closed: trimesh.Trimesh) -> float:
    """Return 2 V / A in m: the thickness of a plate, 1/2 of the diameter of a rod, 1/3 of that of a ball."""
    return float(2 * closed.volume / closed.area)


def _samples(mesh: trimesh.Trimesh, count: int) -> tuple[Array, Array]:
    """Return points (P, 3) on a surface and their faces (P,)."""
    return surface_samples(mesh, count, np.random.default_rng(0))


def _outside_of_slits(union: trimesh.Trimesh, samples: tuple[Array, Array]) -> Array:
    """Return the points of samples on hulls that are not in a slit between two hulls."""
    points, faces = samples
    normals = np.asarray(union.face_normals)[faces]
    caster = RayMeshIntersector(union)
    found = caster.intersects_id(points + 1e-5 * normals, normals, multiple_hits=False, return_locations=True)
    rays, hits = found[1], found[-1]
    near = np.linalg.norm(hits - points[rays], axis=1) < SLIT
    touched = np.ones(len(points), dtype=bool)
    touched[rays[near]] = False
    return points[touched]


def _distance_p95(points: Array, target: trimesh.Trimesh) -> float:
    """Return the 95th percentile of distances of points (P, 3) from the triangles of the nearest samples."""
    samples, faces = _samples(target, TARGETS)
    nearest = faces[KDTree(samples).query(points, k=NEAREST)[1]]
    starts = np.repeat(points, NEAREST, axis=0)
    ends = trimesh.triangles.closest_point(target.triangles[nearest.ravel()], starts)
    distances = np.linalg.norm(ends - starts, axis=1).reshape(-1, NEAREST).min(axis=1)
    return float(np.percentile(distances, 95))
