"""Measure how well convex hulls approximate the closed source mesh."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from manifold3d import Manifold, OpType
from scipy.spatial import KDTree
from trimesh.ray.ray_pyembree import RayMeshIntersector

from asset_tools.grasps import sample_surface_points
from asset_tools.solids import mesh_to_solid
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
    """Comparison of the convex hulls of an object with its closed mesh.

    Attributes:
        compact: whether the object is neither thin nor hollow. A compact object is judged by ``volume_iou``, another
            object by ``surface_p95``.
        hull_count: number of hulls.
        hull_vertices: number of vertices of the hull with most vertices.
        volume_iou: volume IoU of the closed mesh and the union of the hulls.
        surface_p95: 95th percentile of the distances between the two surfaces, m. Distances are measured from the mesh
            to the hulls and from the hulls to the mesh; the larger percentile counts.
    """

    compact: bool
    hull_count: int
    hull_vertices: int
    volume_iou: float
    surface_p95: float


def measure_hull_quality(closed: trimesh.Trimesh, hulls: list[Array], *, hollow: bool = False) -> HullQuality:
    """Compare convex hulls with the closed mesh from which they were made; deterministic.

    Args:
        closed: watertight mesh, m.
        hulls: vertices (V, 3) of each hull, in the frame of the mesh.
        hollow: whether the object is a container, which is judged by distance for any wall thickness.

    Raises:
        AssetError: the mesh is not a solid.
    """
    overlap = compute_volume_iou(closed, hulls)
    union = _union(hulls).to_mesh()
    surface = trimesh.Trimesh(np.asarray(union.vert_properties)[:, :3], np.asarray(union.tri_verts), process=False)
    return HullQuality(
        compact=not hollow and compute_mean_thickness(closed) >= THIN,
        hull_count=len(hulls),
        hull_vertices=max(len(hull) for hull in hulls),
        volume_iou=overlap,
        surface_p95=max(
            _distance_p95(_samples(closed, SAMPLES)[0], surface),
            _distance_p95(_outside_of_slits(surface, _samples(surface, SAMPLES)), closed),
        ),
    )


def compute_volume_iou(closed: trimesh.Trimesh, hulls: list[Array]) -> float:
    """Return the volume IoU, 0 to 1, of a closed mesh and the union of convex hulls.

    Args:
        closed: watertight mesh.
        hulls: vertices (V, 3) of each hull, in the frame of the mesh.

    Raises:
        AssetError: the mesh is not a solid.
    """
    solid = mesh_to_solid(closed)
    if solid is None:
        expected, found = "a watertight mesh with outward faces", f"watertight: {closed.is_watertight}"
        raise AssetError("the mesh is not a solid", expected=expected, found=found, fix="Close the mesh first.")
    union = _union(hulls)
    shared = (solid ^ union).volume()
    return float(shared / (solid.volume() + union.volume() - shared))


def _union(hulls: list[Array]) -> Manifold:
    return Manifold.batch_boolean([Manifold.hull_points(hull) for hull in hulls], OpType.Add)


def compute_mean_thickness(closed: trimesh.Trimesh) -> float:
    """Return 2 * volume / area in m: the thickness of a plate, or 1/2 of the diameter of a rod."""
    return float(2 * closed.volume / closed.area)


def _samples(mesh: trimesh.Trimesh, count: int) -> tuple[Array, Array]:
    """Return random points (P, 3) on a mesh and the face (P,) of each point; deterministic."""
    return sample_surface_points(mesh, count, np.random.default_rng(0))


def _outside_of_slits(union: trimesh.Trimesh, samples: tuple[Array, Array]) -> Array:
    """Return the samples (K, 3) on a union of hulls that are not in a slit between two hulls.

    Args:
        union: mesh of the union.
        samples: points (P, 3) on the mesh, and the face (P,) of each point.
    """
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
    """Return the 95th percentile of the distances of points (P, 3) from the surface of a mesh, m."""
    samples, faces = _samples(target, TARGETS)
    nearest = faces[KDTree(samples).query(points, k=NEAREST)[1]]
    starts = np.repeat(points, NEAREST, axis=0)
    ends = trimesh.triangles.closest_point(target.triangles[nearest.ravel()], starts)
    distances = np.linalg.norm(ends - starts, axis=1).reshape(-1, NEAREST).min(axis=1)
    return float(np.percentile(distances, 95))
