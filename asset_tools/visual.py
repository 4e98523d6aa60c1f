"""Light copies of scanned meshes for rendering: few faces, one small texture."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import distance_transform_edt
from scipy.spatial import KDTree
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

from asset_tools.glb import get_rgba, get_roughness
from asset_tools.readers.surface import TEXTURE, TINT, Textures, decode_srgb, encode_srgb
from asset_tools.simplify import merge_vertices, orient_outward, simplify_mesh
from robocas_ms3.core.errors import AssetError

Array = NDArray[np.float64]

CREASE = np.cos(np.deg2rad(40))  # faces that meet more sharply get an edge, not a smooth normal
SAMPLES = 150_000  # on the original surface, to find the face that a texel shows
NEAR = 20  # samples whose faces are compared where looks are layered
NORMAL_WEIGHT = 0.02  # of the diagonal; keeps the two sides of a thin shell apart, hardly moves anything else


def to_display(mesh: trimesh.Trimesh, *, triangles: int = 1500, texture_size: int = 512) -> trimesh.Trimesh:
    """A copy of a mesh with few faces and one small texture, in the same frame, its normals outward.

    A textured mesh within the limit keeps its vertices and UVs. A larger one is simplified and unwrapped anew, and
    its colours are baked into the new texture; so are vertex and face colours. One of a single colour has no texture.
    Transparency is dropped.

    Args:
        mesh: textured, coloured or plain; any unit.
        triangles: most faces of the result; up to six times as many where it has many holes or pieces.
        texture_size: largest side of its texture, pixels.

    Returns:
        A mesh with a ``PBRMaterial`` and vertex normals.

    Raises:
        AssetError: the mesh has no faces, or is not finite.
    """
    if len(mesh.faces) == 0 or not np.isfinite(mesh.vertices).all():
        raise AssetError(
            "can't show this mesh", expected="faces, and finite vertices", found=f"{len(mesh.faces)} faces"
        )
    source = Appearance(mesh)
    if len(mesh.faces) <= triangles and (source.plain or source.single is not None):
        vertices, faces, normals, origin = _shaded(mesh)
        if mesh.volume < 0:
            faces, normals = faces[:, ::-1], -normals
        uv = None if source.plain else source.uv[origin]
        texture = None if source.single is None else _shrunk(source.single, texture_size)
    else:
        kept = source.layered and len(mesh.faces) <= triangles
        body = orient_outward(mesh) if kept else simplify_mesh(mesh, triangles)
        corner_normals = _crease_normals(body)
        faces, uv, texture = np.asarray(body.faces), None, None
        origin = np.arange(len(body.vertices))
        if not source.plain:
            origin, faces, uv = _unwrapped(body, texture_size)
            texture = _baked(mesh, source, body, uv[faces], corner_normals, texture_size, same_faces=kept)
        # a vertex for every different pair of UV vertex and normal
        keys = np.column_stack([faces.reshape(-1), np.rint(corner_normals.reshape(-1, 3) * 1e4)])
        _, first, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
        vertices = np.asarray(body.vertices)[origin[faces.reshape(-1)[first]]]
        uv = None if uv is None else uv[faces.reshape(-1)[first]]
        normals, faces = corner_normals.reshape(-1, 3)[first], inverse.reshape(-1, 3)
    material = PBRMaterial(
        baseColorTexture=texture,
        baseColorFactor=np.array([*source.factor[:3], 255], dtype=np.uint8),
        metallicFactor=0.0,
        roughnessFactor=source.roughness,
    )
    visual = TextureVisuals(uv=uv, material=material)
    return trimesh.Trimesh(vertices, faces, vertex_normals=normals, visual=visual, process=False)


class Appearance:
    """What a mesh looks like: images and UVs with linear tints, or else colours of the corners, sRGB, 0 to 255.

    Attributes:
        images: RGB; empty: colours alone.
        texture: (F,) index of the image of each face.
        uv: (V, 2).
        tints: (F, 3, 3) linear, of the corners; None: none.
        colors: (F, 3, 3) of the corners, where there are no images.
        plain: one colour everywhere.
        factor: (3,) or (4,) linear colour that the material of the result keeps, 0 to 255.
        roughness: that it keeps.
    """

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        visual: Any = mesh.visual
        material: Any = getattr(visual, "material", None)
        uv = getattr(visual, "uv", None)
        self.roughness, self.factor = get_roughness(material), get_rgba(None)
        self.uv = np.zeros((0, 2)) if uv is None else np.array(uv, dtype=float)
        self.texture, self.tints = np.zeros(len(mesh.faces), int), None
        images: Sequence[Image.Image | None]
        if isinstance(material, Textures):
            images = material.images
            self.texture = np.asarray(mesh.vertex_attributes[TEXTURE])[mesh.faces[:, 0]]
            self.tints = np.asarray(mesh.vertex_attributes[TINT])[mesh.faces]
        elif isinstance(material, PBRMaterial):
            images, self.factor = [material.baseColorTexture], get_rgba(material.baseColorFactor)
        else:
            images = [getattr(material, "image", None)]  # a diffuse colour next to it is a mere default
        self.images = [] if uv is None else [image.convert("RGB") for image in images if image is not None]
        self.colors = np.full((len(mesh.faces), 3, 3), 255.0)
        if visual.kind == "face":
            self.colors = np.repeat(np.asarray(visual.face_colors, dtype=float)[:, None, :3], 3, axis=1)
        elif visual.kind == "vertex":
            self.colors = np.asarray(visual.vertex_colors, dtype=float)[mesh.faces][:, :, :3]
        elif material is not None and not isinstance(material, PBRMaterial):
            self.colors = np.broadcast_to(get_rgba(material.main_color)[:3], (len(mesh.faces), 3, 3))
        self.plain = not self.images and bool((self.colors == self.colors[0, 0]).all())
        if self.plain and not isinstance(material, PBRMaterial):
            self.factor = 255 * decode_srgb(self.colors[0, 0])

    @property
    def layered(self) -> bool:
        """Whether surfaces of different looks may be close together."""
        return len(self.images) > 1 or self.tints is not None

    @property
    def single(self) -> Image.Image | None:
        """The image, where it is all there is to see."""
        return self.images[0] if len(self.images) == 1 and self.tints is None else None

    def at(self, faces: NDArray, face: NDArray, weights: Array) -> Array:
        """Return colours (N, 3) of points, sRGB, 0 to 255.

        Args:
            faces: (F, 3) of the mesh.
            face: (N,) that each point is on.
            weights: (N, 3) of its corners.
        """
        if not self.images:
            return np.einsum("nc,ncd->nd", weights, self.colors[face])
        colors = np.empty((len(face), 3))
        for index, pixels in enumerate(self.images):
            here = np.flatnonzero(self.texture[face] == index)
            own = self.uv[faces[self.texture == index]]
            spread = _double_area(own).sum() / 2 * pixels.width * pixels.height / max(1, len(here))
            scale = min(max(1, round(np.sqrt(spread))), max(pixels.size))
            image = pixels.reduce(scale)  # finer detail would only alias
            spots = np.einsum("nc,ncd->nd", weights[here], self.uv[faces[face[here]]])
            colors[here] = _bilinear(np.asarray(image, dtype=np.float32), spots)
        if self.tints is not None:
            tints = np.einsum("nc,ncd->nd", weights, self.tints[face])
            colors = encode_srgb(decode_srgb(colors) * tints).astype(float)
        return colors


def _shrunk(image: Image.Image, size: int) -> Image.Image:
    scale = size / max(image.size)
    if scale >= 1:
        return image
    width, height = (max(1, round(side * scale)) for side in image.size)
    return image.resize((width, height), Image.Resampling.BOX if scale <= 0.5 else Image.Resampling.LANCZOS)


def _shaded(mesh: trimesh.Trimesh) -> tuple[Array, NDArray, Array, NDArray]:
    """Return vertices, faces and normals of a mesh, and the vertex that each comes from.

    Where the mesh has no normals of its own, vertices are split at sharp edges.
    """
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces)
    own = mesh._cache.cache.get("vertex_normals")
    if own is not None:
        return vertices, faces, np.array(own), np.arange(len(vertices))
    merged = trimesh.Trimesh(vertices, faces, process=False)
    merged.merge_vertices(digits_vertex=None)
    normals = _crease_normals(merged).reshape(-1, 3)
    keys = np.column_stack([faces.reshape(-1), np.rint(normals * 1e4)])
    _, first, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    origin = faces.reshape(-1)[first]
    return vertices[origin], inverse.reshape(-1, 3), normals[first], origin


def _crease_normals(body: trimesh.Trimesh) -> Array:
    """(F, 3, 3) normals of the corners: the mean of those faces round the vertex that bend away little."""
    faces = np.asarray(body.faces)
    corner_vertex = faces.reshape(-1)
    order = np.argsort(corner_vertex, kind="stable")
    counts = np.bincount(corner_vertex, minlength=len(body.vertices))
    starts = np.cumsum(counts) - counts
    many = counts[corner_vertex]
    one = np.repeat(np.arange(len(corner_vertex)), many)
    step = np.arange(len(one)) - np.repeat(np.cumsum(many) - many, many)
    other = order[np.repeat(starts[corner_vertex], many) + step]
    normals = np.asarray(body.face_normals)
    smooth = (normals[one // 3] * normals[other // 3]).sum(axis=1) >= CREASE
    one, other = one[smooth], other[smooth]
    weighted = normals[other // 3] * np.asarray(body.face_angles).reshape(-1)[other, None]
    total = np.stack([np.bincount(one, weighted[:, axis], len(corner_vertex)) for axis in range(3)], axis=1)
    total /= np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)
    return total.reshape(-1, 3, 3)


def _unwrapped(body: trimesh.Trimesh, size: int) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """The vertex that each UV vertex comes from, faces of UV vertices and (V, 2) UVs in 0 to 1, without overlaps."""
    import xatlas

    scaled = (np.asarray(body.vertices) - body.bounds[0]) / np.linalg.norm(body.extents)
    atlas = xatlas.Atlas()
    atlas.add_mesh(scaled.astype(np.float32), np.asarray(body.faces, dtype=np.uint32))
    options = xatlas.PackOptions()
    options.resolution, options.padding, options.bilinear = size, 2, True
    atlas.generate(pack_options=options)
    origin, faces, uv = atlas[0]
    return origin.astype(np.int64), faces.astype(np.int64), uv.astype(float)


def _baked(
    mesh: trimesh.Trimesh,
    source: Appearance,
    body: trimesh.Trimesh,
    corner_uv: Array,
    corner_normals: Array,
    size: int,
    *,
    same_faces: bool = False,
) -> Image.Image:
    """Return the new texture: every texel shows the point of the original surface next to it.

    Args:
        mesh: the original.
        source: what it looks like.
        body: what the texture is for.
        corner_uv: (F, 3, 2) of it.
        corner_normals: (F, 3, 3) of it.
        size: of the texture, pixels.
        same_faces: the faces of ``body`` are those of ``mesh``, in the same order.
    """
    rows, columns, face, weights = _rasterised(corner_uv, size)
    if same_faces:
        turned = (np.asarray(body.faces)[:, 0] != np.asarray(merge_vertices(mesh).faces)[:, 0]).any()
        origin_face, origin_weights = face, weights[:, ::-1] if turned else weights
    else:
        points = np.einsum("nc,ncd->nd", weights, np.asarray(body.triangles)[face])
        normals = np.einsum("nc,ncd->nd", weights, corner_normals[face])
        origin_face, origin_weights = _closest(mesh, points, normals, layered=source.layered)
    colors = source.at(np.asarray(mesh.faces), origin_face, origin_weights)
    pixels = np.zeros((size, size, 3), dtype=np.uint8)
    empty = np.ones((size, size), dtype=bool)
    pixels[rows, columns] = np.clip(np.rint(colors), 0, 255)
    empty[rows, columns] = False
    near: Any = distance_transform_edt(empty, return_distances=False, return_indices=True)
    return Image.fromarray(pixels[near[0], near[1]])  # gaps show their neighbours, so that no seam is dark


def _rasterised(corner_uv: Array, size: int) -> tuple[NDArray, NDArray, NDArray, Array]:
    """Row, column, face and (N, 3) barycentric weights of each texel that a face covers, or that lies one beside."""
    corners = corner_uv * (size, -size) + (-0.5, size - 0.5)  # (F, 3, 2) column, row; whole numbers are centres
    areas = _double_area(corners)
    index = np.flatnonzero(areas > 1e-9)
    low = np.clip(np.floor(corners[index].min(axis=1)).astype(int), 0, size - 1)
    high = np.clip(np.ceil(corners[index].max(axis=1)).astype(int), 0, size - 1)
    extent = high - low + 1
    many = extent.prod(axis=1)
    pick = np.repeat(np.arange(len(index)), many)
    step = np.arange(len(pick)) - np.repeat(np.cumsum(many) - many, many)
    column, row = low[pick, 0] + step % extent[pick, 0], low[pick, 1] + step // extent[pick, 0]
    face = index[pick]
    weights = _barycentric(corners, face, np.column_stack([column, row]))
    edges = np.linalg.norm(corners[:, [2, 0, 1]] - corners[:, [1, 2, 0]], axis=2)
    inside = (weights * areas[face, None] / edges[face]).min(axis=1)  # distance to the nearest edge, texels
    keep = np.flatnonzero(inside > -1)
    keep = keep[np.argsort(inside[keep], kind="stable")][::-1]  # the face that holds a texel best comes first
    _, first = np.unique(row[keep] * size + column[keep], return_index=True)
    keep = keep[first]
    return row[keep], column[keep], face[keep], _clamped(weights[keep])


def _closest(mesh: trimesh.Trimesh, points: Array, normals: Array, *, layered: bool) -> tuple[NDArray, Array]:
    """Return the face of the original next to each point, and (N, 3) weights of its corners.

    Args:
        mesh: the original.
        points: (N, 3).
        normals: (N, 3); faces that look another way are far.
        layered: surfaces of different looks may be close together, such as a label on a bottle.
    """
    triangles = np.asarray(mesh.triangles)
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    areas = np.linalg.norm(cross, axis=1)
    facing = cross / np.maximum(areas, 1e-30)[:, None] * (-1 if mesh.volume < 0 else 1)
    solid = np.flatnonzero(areas > 0)
    count = 1 + np.floor(SAMPLES * areas[solid] / areas.sum()).astype(int)
    face = np.repeat(solid, count)
    spots = np.random.default_rng(0).dirichlet((1, 1, 1), len(face))
    reach = NORMAL_WEIGHT * float(np.linalg.norm(mesh.extents))
    places = np.einsum("nc,ncd->nd", spots, triangles[face])
    tree = KDTree(np.hstack([places, reach * facing[face]]), balanced_tree=False)
    lengths = np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    near = tree.query(np.hstack([points, reach * normals / lengths]), k=NEAR if layered else 1)[1]
    if not layered:
        return face[near], _clamped(_barycentric(triangles, face[near], points))
    best, weights = np.zeros(len(points), int), np.zeros((len(points), 3))
    shortest = np.full(len(points), np.inf)
    for candidates in face[near].T:  # samples tell layers apart only where they are dense
        spread = _clamped(_barycentric(triangles, candidates, points))
        distance = np.linalg.norm(np.einsum("nc,ncd->nd", spread, triangles[candidates]) - points, axis=1)
        nearer = distance < shortest
        best[nearer], weights[nearer], shortest[nearer] = candidates[nearer], spread[nearer], distance[nearer]
    return best, weights


def _barycentric(triangles: Array, face: NDArray, points: Array) -> Array:
    """(N, 3) weights of points, projected to the plane of their face, in any dimension."""
    first, second = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    aa, ab, bb = (first * first).sum(axis=1), (first * second).sum(axis=1), (second * second).sum(axis=1)
    scale = 1 / np.maximum(aa * bb - ab * ab, 1e-300)
    to_second = (first * bb[:, None] - second * ab[:, None]) * scale[:, None]
    to_third = (second * aa[:, None] - first * ab[:, None]) * scale[:, None]
    offset = points - triangles[face, 0]
    beta, gamma = (offset * to_second[face]).sum(axis=1), (offset * to_third[face]).sum(axis=1)
    return np.column_stack([1 - beta - gamma, beta, gamma])


def _clamped(weights: Array) -> Array:
    weights = np.maximum(weights, 0)
    return weights / weights.sum(axis=1, keepdims=True)


def _double_area(corners: Array) -> Array:
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])


def _bilinear(image: NDArray[np.float32], uv: Array) -> Array:
    """(N, 3) colours at (N, 2) UVs, v upward; outside of 0 to 1 the image repeats."""
    height, width = image.shape[:2]
    column, row = uv[:, 0] * width - 0.5, (1 - uv[:, 1]) * height - 0.5
    left, top = np.floor(column).astype(int), np.floor(row).astype(int)
    across, down = (column - left)[:, None], (row - top)[:, None]
    left, right, top, bottom = left % width, (left + 1) % width, top % height, (top + 1) % height
    upper = image[top, left] * (1 - across) + image[top, right] * across
    lower = image[bottom, left] * (1 - across) + image[bottom, right] * across
    return upper * (1 - down) + lower * down
