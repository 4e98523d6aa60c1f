"""Convert meshes to solids of manifold3d and back."""

from __future__ import annotations

import numpy as np
import trimesh
from manifold3d import Error, Manifold, Mesh64


def mesh_to_solid(mesh: trimesh.Trimesh) -> Manifold | None:
    """Convert a watertight mesh with outward faces to a solid of manifold3d.

    Return None if the solid is invalid.
    """
    # copies, since manifold3d requires writable arrays
    vertices, faces = np.array(mesh.vertices, np.float64, order="C"), np.array(mesh.faces, np.uint64, order="C")
    solid = Manifold(Mesh64(vertices, faces))
    return solid if solid.status() == Error.NoError else None


def solid_to_mesh(solid: Manifold) -> trimesh.Trimesh:
    """Convert a solid of manifold3d to a watertight mesh."""
    mesh = solid.to_mesh64()
    return trimesh.Trimesh(np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts, np.int64), process=False)
