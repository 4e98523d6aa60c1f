"""Make closed, textured meshes from grids of points.

A *patch* is a grid of points on the surface. It shows one rectangle of the texture, a *region*. Patches that together
enclose a volume are a *part*. The union of the parts is a *shape*. Frames: metres, z up, front towards -y.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

WELD = 1e-7  # m: vertices closer than this are merged
PADDING = 4  # pixels around a region, filled with the colours of its border, so that mip levels do not mix regions
CREASE_DEG = 40.0

Size = tuple[float, float, float]


@dataclass(frozen=True)
class Patch:
    """A grid of surface points that shows one region of the texture.

    Args:
        region: name of the texture region; patches with the same region must have the same ``size``.
        points: (m, n, 3) points, m; seen from outside, columns run to the right and rows upwards.
        uv: (m, n, 2) texture coordinates in the region, 0 to 1, v upwards.
        size: width and height of the region in metres; larger regions get more pixels.
        detail: factor of the number of pixels per metre.
    """

    region: str
    points: np.ndarray
    uv: np.ndarray
    size: tuple[float, float]
    detail: float = 1.0


@dataclass(frozen=True)
class Region:
    """A rectangle of the texture.

    Attributes:
        size: width and height on the surface, m.
        box: left, top, right and bottom in the texture, pixels.
    """

    size: tuple[float, float]
    box: tuple[int, int, int, int]


@dataclass(frozen=True)
class Shape:
    """A closed surface with texture coordinates.

    Vertices are split at seams of the texture and at sharp edges.

    Args:
        vertices: (n, 3) vertices, m.
        faces: (f, 3) indices of vertices.
        normals: (n, 3) outward unit normals.
        uv: (n, 2) texture coordinates, 0 to 1, v upwards.
        regions: name -> region of the texture.
        texture_size: width and height of the texture in pixels.
        pieces: points (k, 3) of each convex collision piece, m; empty: computed later by convex decomposition.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    uv: np.ndarray
    regions: dict[str, Region]
    texture_size: int
    pieces: tuple[np.ndarray, ...] = ()

    def make_closed_mesh(self) -> trimesh.Trimesh:
        """Return the watertight mesh of the surface, with vertices merged by position and without texture."""
        points, index = weld(self.vertices)
        return trimesh.Trimesh(points, index[self.faces], process=False)

    def make_textured_mesh(self, image: Image.Image, *, roughness: float = 0.5) -> trimesh.Trimesh:
        """Return the mesh for rendering, with vertex normals and the texture ``image``."""
        material = PBRMaterial(
            baseColorTexture=image, baseColorFactor=[255, 255, 255, 255], metallicFactor=0.0, roughnessFactor=roughness
        )
        visual = TextureVisuals(uv=self.uv, material=material)
        return trimesh.Trimesh(
            self.vertices, self.faces, vertex_normals=self.normals, visual=visual, process=False, validate=False
        )


def build_shape(parts: list[list[Patch]], *, texture_size: int = 512, crease_deg: float = CREASE_DEG) -> Shape:
    """Return the union of closed parts as one shape with one texture.

    Args:
        parts: patches of each part, m.
        texture_size: width and height of the texture in pixels.
        crease_deg: angle between two faces above which the edge is sharp.

    Raises:
        ValueError: a part is not closed.
    """
    regions = pack_regions([patch for part in parts for patch in part], texture_size)
    pieces = [_join(part, regions, texture_size) for part in parts]
    vertices, uv, faces = pieces[0] if len(pieces) == 1 else _unite(pieces)
    return _with_normals(vertices, uv, faces, regions, texture_size, crease_deg)


def build_fitted_shape(
    parts: list[list[Patch]], size: Size, *, pieces: Sequence[np.ndarray] = (), tolerance: float = 0.2
) -> Shape:
    """Return the union of closed parts as a shape, centred and scaled along each axis to an exact size.

    Args:
        parts: patches of each part, m.
        size: outer size (x, y, z) of the shape, m.
        pieces: points (k, 3) of each convex collision piece in the frame of the parts, m.
        tolerance: largest allowed change of a size by scaling, as a fraction.

    Raises:
        ValueError: the size along an axis would change by more than ``tolerance``, or a part is not closed.
    """
    shape = build_shape(parts)
    low, high = shape.vertices.min(0), shape.vertices.max(0)
    factor = np.asarray(size) / (high - low)
    if np.abs(factor - 1).max() > tolerance:
        raise ValueError(f"the parts do not fit the shape: expected a size of {size} m, found {high - low} m")
    middle = (low + high) / 2
    stretched = [
        [Patch(p.region, (p.points - middle) * factor, p.uv, p.size, p.detail) for p in part] for part in parts
    ]
    return replace(build_shape(stretched), pieces=tuple((piece - middle) * factor for piece in pieces))


def make_creased_shape(
    vertices: np.ndarray,
    uv: np.ndarray,
    faces: np.ndarray,
    texture_size: int,
    pieces: tuple[np.ndarray, ...] = (),
    *,
    crease_deg: float = CREASE_DEG,
) -> Shape:
    """Return a closed surface that has texture coordinates as a shape without regions.

    Args:
        vertices: (n, 3) vertices, split at seams of the texture, m.
        uv: (n, 2) texture coordinates.
        faces: (f, 3) indices of vertices.
        texture_size: width and height of the texture in pixels.
        pieces: points (k, 3) of each convex collision piece, m.
        crease_deg: angle between two faces above which the edge is sharp.
    """
    return replace(_with_normals(vertices, uv, faces, {}, texture_size, crease_deg), pieces=pieces)


def weld(vertices: np.ndarray, tolerance: float = WELD) -> tuple[np.ndarray, np.ndarray]:
    """Merge vertices (n, 3) by position.

    Return distinct positions (k, 3) and the index (n,) of each position.
    """
    _, first, index = np.unique(
        np.round(vertices / tolerance).astype(np.int64), axis=0, return_index=True, return_inverse=True
    )
    return vertices[first], index.reshape(-1)


def pack_regions(patches: list[Patch], texture_size: int) -> dict[str, Region]:
    """Pack the regions of patches in rows into a texture, as large as possible.

    Args:
        patches: all patches of a shape.
        texture_size: width and height of the texture in pixels.

    Returns:
        Name -> region.

    Raises:
        ValueError: two patches of one region have different sizes, or the regions do not fit.
    """
    wanted: dict[str, tuple[float, float, float]] = {}
    for patch in patches:
        entry = (*patch.size, patch.detail)
        if not np.allclose(wanted.setdefault(patch.region, entry), entry, atol=1e-6):
            raise ValueError(f"patches of the region {patch.region} differ in size: {wanted[patch.region]} and {entry}")
    order = sorted(wanted, key=lambda name: (-wanted[name][1] * wanted[name][2], name))

    def shelves(scale: float) -> dict[str, tuple[int, int, int, int]] | None:
        boxes, left, top, height = {}, 0, 0, 0
        for name in order:
            wide, high = (max(2, round(size * wanted[name][2] * scale)) + 2 * PADDING for size in wanted[name][:2])
            if left + wide > texture_size:
                left, top, height = 0, top + height, 0
            if wide > texture_size or top + high > texture_size:
                return None
            boxes[name] = (left + PADDING, top + PADDING, left + wide - PADDING, top + high - PADDING)
            left, height = left + wide, max(height, high)
        return boxes

    low, high = 1.0, 1e6  # pixels per metre
    for _ in range(40):
        middle = (low * high) ** 0.5
        low, high = (middle, high) if shelves(middle) else (low, middle)
    boxes = shelves(low)
    if boxes is None:
        raise ValueError(f"the regions {order} do not fit in a texture of {texture_size} pixels")
    return {name: Region(wanted[name][:2], boxes[name]) for name in order}


def _join(
    part: list[Patch], regions: dict[str, Region], texture_size: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Triangulate the patches of a part.

    Return vertices (n, 3), UVs (n, 2) in the texture and triangles (f, 3).

    Triangles without area, at poles, are left out.
    """
    vertices, uvs, faces, offset = [], [], [], 0
    for patch in part:
        rows, columns = patch.points.shape[:2]
        left, top, right, bottom = regions[patch.region].box
        u = (left + 0.5 + patch.uv[..., 0] * (right - left - 1)) / texture_size
        v = 1 - (bottom - 0.5 - patch.uv[..., 1] * (bottom - top - 1)) / texture_size
        index = np.arange(rows * columns).reshape(rows, columns) + offset
        a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
        faces.append(np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3))
        vertices.append(patch.points.reshape(-1, 3))
        uvs.append(np.stack([u, v], axis=-1).reshape(-1, 2))
        offset += rows * columns
    vertices, uv, faces = np.concatenate(vertices), np.concatenate(uvs), np.concatenate(faces)
    points, index = weld(vertices)
    corner = index[faces]
    full = (corner[:, 0] != corner[:, 1]) & (corner[:, 1] != corner[:, 2]) & (corner[:, 2] != corner[:, 0])
    return points[index], uv, faces[full]


def _unite(pieces: list[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the boolean union of parts, each given by vertices, UVs and triangles, in the same form."""
    import manifold3d

    solids = []
    for vertices, uv, faces in pieces:
        points, index = weld(vertices)
        first = np.unique(index, return_index=True)[1]
        twins = np.flatnonzero(first[index] != np.arange(len(index)))
        mesh = manifold3d.Mesh64(
            np.ascontiguousarray(np.hstack([points[index], uv])),
            np.ascontiguousarray(faces, dtype=np.uint64),
            merge_from_vert=twins.astype(np.uint64),
            merge_to_vert=first[index[twins]].astype(np.uint64),
        )
        solid = manifold3d.Manifold(mesh)
        if solid.status() != manifold3d.Error.NoError or solid.is_empty():
            raise ValueError(f"a part of the shape is not closed: {solid.status()}")
        solids.append(solid)
    mesh = manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Add).to_mesh64()
    properties, faces = np.asarray(mesh.vert_properties), np.asarray(mesh.tri_verts).astype(np.int64)
    target = np.arange(len(properties))
    target[np.asarray(mesh.merge_from_vert, dtype=np.int64)] = np.asarray(mesh.merge_to_vert, dtype=np.int64)
    return properties[target, :3], properties[:, 3:5], faces


def _with_normals(
    vertices: np.ndarray,
    uv: np.ndarray,
    faces: np.ndarray,
    regions: dict[str, Region],
    texture_size: int,
    crease_deg: float,
) -> Shape:
    """Return a shape with vertex normals.

    A normal is the mean over adjacent faces within ``crease_deg``, weighted by the area and angle of each face.
    """
    points, index = weld(vertices)
    corners = index[faces]
    sides = points[np.roll(corners, -1, axis=1)] - points[corners]
    cross = np.cross(sides[:, 0], sides[:, 1])
    area = np.linalg.norm(cross, axis=1)
    flat = cross / np.maximum(area, 1e-300)[:, None]
    unit = sides / np.maximum(np.linalg.norm(sides, axis=2, keepdims=True), 1e-300)
    angle = np.arccos(np.clip(-(unit * np.roll(unit, 1, axis=1)).sum(2), -1, 1))
    # all pairs of corners at one point
    order = np.argsort(corners.reshape(-1), kind="stable")
    counts = np.bincount(corners.reshape(-1), minlength=len(points))
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    normals = np.zeros((faces.size, 3))
    face_of = np.repeat(np.arange(len(faces)), 3)
    limit = np.cos(np.deg2rad(crease_deg))
    weight = (area[:, None] * angle).reshape(-1)
    for count in np.unique(counts[counts > 0]):
        group = order[starts[counts == count][:, None] + np.arange(count)]  # (points, count)
        normal = flat[face_of[group]]
        near = np.einsum("pik,pjk->pij", normal, normal) > limit
        summed = np.einsum("pij,pj,pjk->pik", near, weight[group], normal)
        normals[group.reshape(-1)] = summed.reshape(-1, 3)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    corner_uv = uv[faces.reshape(-1)]
    key = np.hstack([corners.reshape(-1, 1), np.round(corner_uv * 1e5), np.round(normals * 1e3)]).astype(np.int64)
    _, first, inverse = np.unique(key, axis=0, return_index=True, return_inverse=True)
    return Shape(
        points[corners.reshape(-1)[first]],
        inverse.reshape(-1, 3),
        normals[first],
        np.clip(corner_uv[first], 0, 1),
        regions,
        texture_size,
    )
