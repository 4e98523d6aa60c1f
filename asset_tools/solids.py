"""Meshes to manifold3d's solids and back."""

from __future__ import annotations

import numpy as np
import trimesh
from manifold3d import Error, Manifold, Mesh64


def to_solid(mesh: trimesh.Trimesh) -> Manifold | None:
    """A watertight mesh with its faces outwards as a solid; none if it isn't one."""
    # copies, for it takes no arrays that can't be written to
    vertices, faces = np.array(mesh.vertices, np.float64, order="C"), np.array(mesh.faces, np.uint64, order="C")
    solid = Manifold(Mesh64(vertices, faces))
    return solid if solid.status() == Error.NoError else None


def to_mesh(solid: Manifold) -> trimesh.Trimesh:
    """A solid's surface."""
    mesh = solid.to_mesh64()
    return trimesh.Trimesh(np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts, np.int64), process=False)
