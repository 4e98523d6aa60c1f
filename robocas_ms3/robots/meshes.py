"""Write low-polygon visual meshes: decimated GLB files and coloured boxes, which render fast in software."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import fast_simplification
import numpy as np
import trimesh
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

SMOOTH_ANGLE = np.radians(40.0)
"""Angle in rad; edges with a larger angle stay sharp in the shading."""

Box = tuple[Sequence[float], Sequence[float], Sequence[float]]
"""Size (3,) and centre (3,) in m, and RGB colour in 0..1."""


def decimate_glb(source: Path, target: Path, triangles: int) -> int:
    """Write a copy of a GLB file with about ``triangles`` triangles and the same materials.

    Returns:
        Number of triangles of the copy.
    """
    scene = trimesh.load(source, force="scene")
    assert isinstance(scene, trimesh.Scene)
    total = sum(len(g.faces) for g in scene.geometry.values())
    written = trimesh.Scene()
    count = 0
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        mesh: trimesh.Trimesh = scene.geometry[name].copy()
        mesh.apply_transform(transform)
        assert isinstance(mesh.visual, TextureVisuals)
        material = mesh.visual.material
        mesh.merge_vertices(merge_tex=True, merge_norm=True)
        wanted = max(12, round(triangles * len(mesh.faces) / total))
        if wanted < len(mesh.faces):
            simplified = fast_simplification.simplify(
                np.array(mesh.vertices), np.array(mesh.faces), target_count=wanted, agg=5.0
            )
            mesh = trimesh.Trimesh(simplified[0], simplified[1])
        part = trimesh.graph.smooth_shade(mesh, angle=SMOOTH_ANGLE)
        part.visual = TextureVisuals(material=material)
        part.vertex_normals  # noqa: B018 - computed here to be exported
        written.add_geometry(part, geom_name=f"part{len(written.geometry)}")
        count += len(part.faces)
    target.write_bytes(_glb(written))
    return count


def write_boxes_glb(target: Path, boxes: Sequence[Box]) -> None:
    """Write coloured boxes as one GLB file.

    SAPIEN cannot load a URDF ``<box>`` with a material if there is no renderer. It can load a URDF with a mesh file,
    because it does not read the file then.
    """
    scene = trimesh.Scene()
    for i, (size, centre, colour) in enumerate(boxes):
        mesh = trimesh.creation.box(extents=size)
        mesh.apply_translation(centre)
        mesh.unmerge_vertices()
        material = PBRMaterial(baseColorFactor=[*colour, 1.0], metallicFactor=0.0, roughnessFactor=0.6)
        mesh.visual = TextureVisuals(material=material)
        mesh.vertex_normals  # noqa: B018 - computed here to be exported
        scene.add_geometry(mesh, geom_name=f"box{i}")
    target.write_bytes(_glb(scene))


def _glb(scene: trimesh.Scene) -> bytes:
    data = scene.export(file_type="glb", include_normals=True)
    assert isinstance(data, bytes)
    return data
