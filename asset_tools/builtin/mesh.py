"""From grids of points to closed, textured meshes: patches, a texture atlas, creased normals, unions.

A *patch* is a grid of points that shows one rectangle (*region*) of the texture. Patches that together close a volume
make a *part*; parts are united into a *shape*. Frames: metres, z up, front towards -y.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

WELD = 1e-7  # m: corners closer than this are one point of the surface
PADDING = 4  # pixels around a region, filled with its border so that mip levels don't bleed
CREASE_DEG = 40.0

Size = tuple[float, float, float]


@dataclass(frozen=True)
class Patch:
    """A grid of points and what it shows.

    Args:
        region: name of the texture region; patches that show the same one must give it the same size.
        points: (m, n, 3) m; seen from outside, columns run to the right and rows upwards.
        uv: (m, n, 2) in [0, 1] inside the region, v upwards.
        size: (width, height) of the region in metres, which sets its share of the texture.
        detail: how many times more pixels per metre than the rest.
    """

    region: str
    points: np.ndarray
    uv: np.ndarray
    size: tuple[float, float]
    detail: float = 1.0


@dataclass(frozen=True)
class Region:
    """A rectangle of the texture: size in metres, pixel box (left, top, right, bottom)."""

    size: tuple[float, float]
    box: tuple[int, int, int, int]


@dataclass(frozen=True)
class Shape:
    """A closed surface ready for a texture: vertices are split where UVs or normals jump.

    Args:
        vertices: (n, 3) m. faces: (f, 3). normals: (n, 3) unit, outward. uv: (n, 2) in [0, 1], v upwards.
        regions: the texture's regions by name.
        texture_size: width and height of the square texture in pixels.
        pieces: convex collision pieces, points (k, 3) each, where the formulas know them better than a decomposition.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    uv: np.ndarray
    regions: dict[str, Region]
    texture_size: int
    pieces: tuple[np.ndarray, ...] = ()

    def closed(self) -> trimesh.Trimesh:
        """The bare surface, welded by position: watertight, for volume and hulls."""
        points, index = weld(self.vertices)
        return trimesh.Trimesh(points, index[self.faces], process=False)

    def textured(self, image: Image.Image, *, roughness: float = 0.5) -> trimesh.Trimesh:
        """The mesh to render, with vertex normals; the image is embedded as JPEG on export."""
        material = PBRMaterial(
            baseColorTexture=image, baseColorFactor=[255, 255, 255, 255], metallicFactor=0.0, roughnessFactor=roughness
        )
        visual = TextureVisuals(uv=self.uv, material=material)
        return trimesh.Trimesh(
            self.vertices, self.faces, vertex_normals=self.normals, visual=visual, process=False, validate=False
        )


def build_shape(parts: list[list[Patch]], *, texture_size: int = 512, crease_deg: float = CREASE_DEG) -> Shape:
    """Unite closed parts into one shape with one texture atlas.

    Raises:
        ValueError: a part is not closed.
    """
    regions = pack_regions([patch for part in parts for patch in part], texture_size)
    pieces = [_join(part, regions, texture_size) for part in parts]
    vertices, uv, faces = pieces[0] if len(pieces) == 1 else _unite(pieces)
    return _with_normals(vertices, uv, faces, regions, texture_size, crease_deg)


def fitted(parts: list[list[Patch]], size: Size, *, pieces: Sequence[np.ndarray] = (), tolerance: float = 0.2) -> Shape:
    """Build the shape, centred and stretched to its exact size; its convex ``pieces`` likewise.

    Raises:
        ValueError: an axis would have to be stretched by more than ``tolerance``.
    """
    shape = build_shape(parts)
    low, high = shape.vertices.min(0), shape.vertices.max(0)
    factor = np.asarray(size) / (high - low)
    if np.abs(factor - 1).max() > tolerance:
        raise ValueError(f"the formulas give {high - low} m for a shape of {size} m")
    middle = (low + high) / 2
    stretched = [
        [Patch(p.region, (p.points - middle) * factor, p.uv, p.size, p.detail) for p in part] for part in parts
    ]
    return replace(build_shape(stretched), pieces=tuple((piece - middle) * factor for piece in pieces))


def creased_shape(
    vertices: np.ndarray,
    uv: np.ndarray,
    faces: np.ndarray,
    texture_size: int,
    pieces: tuple[np.ndarray, ...] = (),
    *,
    crease_deg: float = CREASE_DEG,
) -> Shape:
    """A shape of any closed surface that is unwrapped already; it has no regions.

    Args:
        vertices: (n, 3) m, split where the UVs jump. uv: (n, 2). faces: (f, 3).
        texture_size: pixels. pieces: see ``Shape``.
        crease_deg: faces that meet more sharply get an edge, not a smooth normal.
    """
    return replace(_with_normals(vertices, uv, faces, {}, texture_size, crease_deg), pieces=pieces)


def weld(vertices: np.ndarray, tolerance: float = WELD) -> tuple[np.ndarray, np.ndarray]:
    """Distinct positions (k, 3) and, for each of the (n, 3) vertices, its position's index (n,)."""
    _, first, index = np.unique(
        np.round(vertices / tolerance).astype(np.int64), axis=0, return_index=True, return_inverse=True
    )
    return vertices[first], index.reshape(-1)


def pack_regions(patches: list[Patch], texture_size: int) -> dict[str, Region]:
    """Pack the patches' regions in rows at the largest common scale that fits.

    Raises:
        ValueError: two patches of one region disagree about its size.
    """
    wanted: dict[str, tuple[float, float, float]] = {}
    for patch in patches:
        entry = (*patch.size, patch.detail)
        if not np.allclose(wanted.setdefault(patch.region, entry), entry, atol=1e-6):
            raise ValueError(f"region {patch.region}: sizes {wanted[patch.region]} and {entry} differ")
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
        raise ValueError(f"the regions {order} don't fit a texture of {texture_size} pixels")
    return {name: Region(wanted[name][:2], boxes[name]) for name in order}


def _join(
    part: list[Patch], regions: dict[str, Region], texture_size: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (n, 3), atlas UVs (n, 2) and triangles (f, 3) of a part, without the empty ones at poles."""
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
    """Boolean union that carries the UVs along."""
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
    """Normals averaged over the neighbouring faces within the crease angle, larger faces counting more."""
    points, index = weld(vertices)
    corners = index[faces]
    sides = points[np.roll(corners, -1, axis=1)] - points[corners]
    cross = np.cross(sides[:, 0], sides[:, 1])
    area = np.linalg.norm(cross, axis=1)
    flat = cross / np.maximum(area, 1e-300)[:, None]
    unit = sides / np.maximum(np.linalg.norm(sides, axis=2, keepdims=True), 1e-300)
    angle = np.arccos(np.clip(-(unit * np.roll(unit, 1, axis=1)).sum(2), -1, 1))
    # All pairs of corners that meet in one point.
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
