"""Make copies of meshes for rendering, with few faces and one small texture."""

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
from asset_tools.readers.surface import TEXTURE, TINT, MultiTextureMaterial, decode_srgb, encode_srgb
from asset_tools.simplify import merge_vertices, orient_outward, simplify_mesh
from robocas_ms3.core.errors import AssetError

Array = NDArray[np.float64]

CREASE = np.cos(np.deg2rad(40))  # cosine of the angle above which an edge stays sharp
SAMPLES = 150_000  # on the original surface, for finding the face of a texel
NEAR = 20  # compared faces for layered surfaces
NORMAL_WEIGHT = 0.02  # of the diagonal; separates the two sides of a thin shell


def make_display_mesh(mesh: trimesh.Trimesh, *, triangles: int = 1500, texture_size: int = 512) -> trimesh.Trimesh:
    """Return a copy of a mesh for rendering, with few faces, one small texture and outward normals.

    A textured mesh with at most ``triangles`` faces keeps its vertices and UVs. A larger mesh is simplified and
    unwrapped again, and its colours are baked into a new texture. Vertex and face colours are also baked. A mesh of one
    colour gets no texture. Transparency is dropped.

    Args:
        mesh: textured or coloured mesh in any frame and unit.
        triangles: maximum number of faces; a mesh with many holes or pieces may keep six times as many.
        texture_size: width and height of the texture, at most, in pixels.

    Returns:
        A mesh with a ``PBRMaterial`` and vertex normals.

    Raises:
        AssetError: the mesh has no faces, or has NaN or infinite vertices.
    """
    if len(mesh.faces) == 0 or not np.isfinite(mesh.vertices).all():
        finite = np.isfinite(mesh.vertices).all(axis=1)
        raise AssetError(
            "cannot render this mesh",
            expected="at least one face, and finite vertices",
            found=f"{len(mesh.faces)} faces, {int((~finite).sum())} vertices with NaN or infinite values",
            fix="Export the mesh again.",
        )
    source = Appearance(mesh)
    if len(mesh.faces) <= triangles and (source.plain or source.single_image is not None):
        vertices, faces, normals, origin = _shaded(mesh)
        if mesh.volume < 0:
            faces, normals = faces[:, ::-1], -normals
        uv = None if source.plain else source.uv[origin]
        texture = None if source.single_image is None else _shrunk(source.single_image, texture_size)
    else:
        kept = source.layered and len(mesh.faces) <= triangles
        body = orient_outward(mesh) if kept else simplify_mesh(mesh, triangles)
        corner_normals = _crease_normals(body)
        faces, uv, texture = np.asarray(body.faces), None, None
        origin = np.arange(len(body.vertices))
        if not source.plain:
            origin, faces, uv = _unwrapped(body, texture_size)
            texture = _baked(mesh, source, body, uv[faces], corner_normals, texture_size, same_faces=kept)
        # one vertex per pair of UV vertex and normal
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
    """Colours of a mesh: texture images, or one colour per corner of a face.

    Attributes:
        images: RGB texture images; empty: the mesh has only colours.
        texture: (F,) index of the image of each face.
        uv: (V, 2) texture coordinates.
        tints: (F, 3, 3) linear RGB factors per corner, by which the image is multiplied; None: no factors.
        colors: (F, 3, 3) sRGB colours per corner, 0 to 255; used if there are no images.
        plain: whether the whole mesh has one colour.
        factor: (3,) or (4,) linear colour factor of the material that is written, 0 to 255.
        roughness: roughness of the material that is written.
    """

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        visual: Any = mesh.visual
        material: Any = getattr(visual, "material", None)
        uv = getattr(visual, "uv", None)
        self.roughness, self.factor = get_roughness(material), get_rgba(None)
        self.uv = np.zeros((0, 2)) if uv is None else np.array(uv, dtype=float)
        self.texture, self.tints = np.zeros(len(mesh.faces), int), None
        images: Sequence[Image.Image | None]
        if isinstance(material, MultiTextureMaterial):
            images = material.images
            self.texture = np.asarray(mesh.vertex_attributes[TEXTURE])[mesh.faces[:, 0]]
            self.tints = np.asarray(mesh.vertex_attributes[TINT])[mesh.faces]
        elif isinstance(material, PBRMaterial):
            images, self.factor = [material.baseColorTexture], get_rgba(material.baseColorFactor)
        else:
            images = [getattr(material, "image", None)]  # a diffuse colour in addition to an image is a default value
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
        """Whether surfaces with different images may be close to each other, as a label on a bottle."""
        return len(self.images) > 1 or self.tints is not None

    @property
    def single_image(self) -> Image.Image | None:
        """The image of a mesh with exactly one image and without tints; otherwise None."""
        return self.images[0] if len(self.images) == 1 and self.tints is None else None

    def sample_colors(self, faces: NDArray, face: NDArray, weights: Array) -> Array:
        """Return the sRGB colours (N, 3) of N points on the mesh, 0 to 255.

        Args:
            faces: (F, 3) faces of the mesh.
            face: (N,) index of the face of each point.
            weights: (N, 3) barycentric weights of each point in its face.
        """
        if not self.images:
            return np.einsum("nc,ncd->nd", weights, self.colors[face])
        colors = np.empty((len(face), 3))
        for index, pixels in enumerate(self.images):
            here = np.flatnonzero(self.texture[face] == index)
            own = self.uv[faces[self.texture == index]]
            spread = _double_area(own).sum() / 2 * pixels.width * pixels.height / max(1, len(here))
            scale = min(max(1, round(np.sqrt(spread))), max(pixels.size))
            image = pixels.reduce(scale)  # finer details would alias
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
    """Return a mesh with the normals of the file, or with normals that have sharp edges above 40 deg.

    Returns:
        Vertices (V, 3), faces (F, 3), normals (V, 3), and for each vertex the index (V,) of a vertex of ``mesh``.
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
    """Return a normal per corner (F, 3, 3): the mean over adjacent faces within 40 deg of the face."""
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
    """Unwrap a mesh to a square texture of ``size`` pixels.

    Returns:
        The vertex of ``body`` (W,) for each of W UV vertices, the faces (F, 3) as indices of UV vertices, and the
        UVs (W, 2) in 0..1 without overlaps.
    """
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
    """Bake a texture for a simplified mesh from the closest points of the original mesh.

    Args:
        mesh: original mesh.
        source: colours of the original mesh.
        body: simplified mesh.
        corner_uv: (F, 3, 2) UVs of the corners of ``body``.
        corner_normals: (F, 3, 3) normals of the corners of ``body``.
        size: width and height of the texture in pixels.
        same_faces: whether ``body`` and ``mesh`` have equal faces in equal order.
    """
    rows, columns, face, weights = _rasterised(corner_uv, size)
    if same_faces:
        turned = (np.asarray(body.faces)[:, 0] != np.asarray(merge_vertices(mesh).faces)[:, 0]).any()
        origin_face, origin_weights = face, weights[:, ::-1] if turned else weights
    else:
        points = np.einsum("nc,ncd->nd", weights, np.asarray(body.triangles)[face])
        normals = np.einsum("nc,ncd->nd", weights, corner_normals[face])
        origin_face, origin_weights = _closest(mesh, points, normals, layered=source.layered)
    colors = source.sample_colors(np.asarray(mesh.faces), origin_face, origin_weights)
    pixels = np.zeros((size, size, 3), dtype=np.uint8)
    empty = np.ones((size, size), dtype=bool)
    pixels[rows, columns] = np.clip(np.rint(colors), 0, 255)
    empty[rows, columns] = False
    near: Any = distance_transform_edt(empty, return_distances=False, return_indices=True)
    return Image.fromarray(pixels[near[0], near[1]])  # fill gaps with their neighbours, to avoid dark seams


def _rasterised(corner_uv: Array, size: int) -> tuple[NDArray, NDArray, NDArray, Array]:
    """Find the texels that faces cover in a texture, with a margin of 1 texel.

    Args:
        corner_uv: (F, 3, 2) UVs of the corners of the faces.
        size: width and height of the texture in pixels.

    Returns:
        Row (N,), column (N,), face (N,) and barycentric weights (N, 3) in this face, for each of N texels.
    """
    corners = corner_uv * (size, -size) + (-0.5, size - 0.5)  # (F, 3, 2) column, row; integers are centres of texels
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
    keep = keep[np.argsort(inside[keep], kind="stable")][::-1]  # the face that contains a texel best comes first
    _, first = np.unique(row[keep] * size + column[keep], return_index=True)
    keep = keep[first]
    return row[keep], column[keep], face[keep], _clamped(weights[keep])


def _closest(mesh: trimesh.Trimesh, points: Array, normals: Array, *, layered: bool) -> tuple[NDArray, Array]:
    """Return the closest face (N,) of a mesh for each point, and barycentric weights (N, 3) in this face.

    Args:
        mesh: original mesh.
        points: (N, 3) points.
        normals: (N, 3) normals at the points; faces with other normals count as far.
        layered: whether surfaces with different images may be close to each other, such as a label on a bottle.
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
    for candidates in face[near].T:  # samples alone distinguish layers only if they are dense
        spread = _clamped(_barycentric(triangles, candidates, points))
        distance = np.linalg.norm(np.einsum("nc,ncd->nd", spread, triangles[candidates]) - points, axis=1)
        nearer = distance < shortest
        best[nearer], weights[nearer], shortest[nearer] = candidates[nearer], spread[nearer], distance[nearer]
    return best, weights


def _barycentric(triangles: Array, face: NDArray, points: Array) -> Array:
    """Return the barycentric weights (N, 3) of points, projected to the planes of their faces.

    Args:
        triangles: (F, 3, D) corners of the faces, in any dimension D.
        face: (N,) face of each point.
        points: (N, D) points.
    """
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
    """Return bilinear samples (N, 3) of a repeating image at UVs (N, 2), v upward."""
    height, width = image.shape[:2]
    column, row = uv[:, 0] * width - 0.5, (1 - uv[:, 1]) * height - 0.5
    left, top = np.floor(column).astype(int), np.floor(row).astype(int)
    across, down = (column - left)[:, None], (row - top)[:, None]
    left, right, top, bottom = left % width, (left + 1) % width, top % height, (top + 1) % height
    upper = image[top, left] * (1 - across) + image[top, right] * across
    lower = image[bottom, left] * (1 - across) + image[bottom, right] * across
    return upper * (1 - down) + lower * down
