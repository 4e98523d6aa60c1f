"""Merge the faces of a link to one mesh whose textures are packed into one image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import fast_simplification
import numpy as np
import trimesh
from PIL import Image
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

from asset_tools.glb import DEFAULT_ROUGHNESS
from asset_tools.partnet.obj import Faces
from asset_tools.readers.files import read_file
from asset_tools.readers.images import open_texture
from asset_tools.visual import _crease_normals
from robocas_ms3.core.errors import AssetError

Array = np.ndarray

HEAVY, LIGHT = 500, 200  # triangles per side of a mesh: limit without reduction, and number after reduction
SIDE = 1024  # pixels, maximum size of the image
DENSITY = 400.0  # maximum pixels per metre
PADDING = 2  # pixels around each tile
PLAIN = 4  # pixels, size of a tile of one colour
GRID = 16  # tiles start and end at multiples of 1/16 of their texture, so that neighbours share them
ENOUGH = 0.6  # minimum resolution relative to the desired one for using another chart's tile


@dataclass(frozen=True)
class _Tile:
    """A rectangle of a texture, given in UV coordinates, or one colour."""

    color: tuple[int, int, int] = (0, 0, 0)
    image: Image.Image | None = None
    low: tuple[float, float] = (0.0, 0.0)
    high: tuple[float, float] = (1.0, 1.0)
    scale: float = 1.0  # pixels per pixel of the texture

    def size(self, shrink: float) -> tuple[int, int]:
        if self.image is None:
            return PLAIN, PLAIN
        pixels = np.subtract(self.high, self.low) * self.image.size * self.scale * shrink
        width, height = np.maximum(np.rint(pixels), 2).astype(int).tolist()
        return width, height

    def draw(self, width: int, height: int) -> Image.Image:
        """Return the image of the tile with a size in pixels and padding on each side; the texture repeats."""
        if self.image is None:
            return Image.new("RGB", (width + 2 * PADDING, height + 2 * PADDING), self.color)
        wanted = np.subtract(self.high, self.low) * self.image.size / (width, height)
        shrink = np.clip(np.floor(wanted), 1, self.image.size).astype(int).tolist()
        image = self.image.reduce(tuple(shrink))  # averages textures that repeat many times in a few pixels
        columns, rows = image.size
        left, right = self.low[0] * columns, self.high[0] * columns
        top, bottom = (1 - self.high[1]) * rows, (1 - self.low[1]) * rows
        across, down = PADDING * (right - left) / width, PADDING * (bottom - top) / height
        box = np.array([left - across, top - down, right + across, bottom + down])
        start, stop = np.floor(box[:2]).astype(int) - 2, np.ceil(box[2:]).astype(int) + 2
        pixels = np.asarray(image)
        pixels = pixels.take(np.arange(start[1], stop[1]), axis=0, mode="wrap")
        pixels = pixels.take(np.arange(start[0], stop[0]), axis=1, mode="wrap")
        size = (width + 2 * PADDING, height + 2 * PADDING)
        inside = tuple((box - np.tile(start, 2)).tolist())
        return Image.fromarray(pixels).resize(size, Image.Resampling.BICUBIC, box=inside)


def merge_faces(faces: Sequence[Faces]) -> trimesh.Trimesh:
    """Merge faces with different materials to one mesh with one texture and an equal appearance.

    Parts with more than 500 faces, such as ornaments, are simplified. A texture that repeats is copied as often as it
    repeats, with at most 400 pixels per metre.

    Args:
        faces: faces of each material in one frame, metres.

    Raises:
        AssetError: a texture cannot be read.
    """
    light = [_simplified(one) for one in faces]
    materials = sorted({one.material for one in light}, key=lambda one: (str(one.image), one.color))
    tiles: list[_Tile] = []
    corners, spots, which = [], [], []
    for material in materials:
        own = [one for one in light if one.material == material]
        places, uv = np.concatenate([one.corners for one in own]), np.concatenate([one.uv for one in own])
        if material.image is None:
            red, green, blue = (round(255 * value) for value in material.color)
            found, index, spot = [_Tile((red, green, blue))], np.zeros(len(places), int), np.full_like(uv, 0.5)
        else:
            found, index, spot = _tiles(places, uv, _opened(material.image))
        corners.append(places)
        spots.append(spot)
        which.append(index + len(tiles))
        tiles += found
    texture_image, boxes = _packed(tiles)
    low, size = boxes[np.concatenate(which)][:, None, :2], boxes[np.concatenate(which)][:, None, 2:]
    spot = np.concatenate(spots)
    spot[..., 1] = 1 - spot[..., 1]
    uv = (low + spot * size) / texture_image.size
    uv[..., 1] = 1 - uv[..., 1]
    return _textured(np.concatenate(corners), uv, texture_image)


def _textured(corners: Array, uv: Array, texture_image: Image.Image) -> trimesh.Trimesh:
    body = _welded(corners)
    keep = body.nondegenerate_faces()
    body.update_faces(keep)
    normals, points = _crease_normals(body), corners[keep].reshape(-1, 3)
    rows = np.column_stack([body.faces.reshape(-1), np.rint(normals.reshape(-1, 3) * 1e3), uv[keep].reshape(-1, 2)])
    _, first, inverse = np.unique(np.round(rows, 6), axis=0, return_index=True, return_inverse=True)
    material = PBRMaterial(baseColorTexture=texture_image, metallicFactor=0.0, roughnessFactor=DEFAULT_ROUGHNESS)
    visual = TextureVisuals(uv=uv[keep].reshape(-1, 2)[first], material=material)
    return trimesh.Trimesh(
        points[first],
        inverse.reshape(-1, 3),
        vertex_normals=normals.reshape(-1, 3)[first],
        visual=visual,
        process=False,
    )


def _welded(corners: Array) -> trimesh.Trimesh:
    body = trimesh.Trimesh(corners.reshape(-1, 3), np.arange(len(corners) * 3).reshape(-1, 3), process=False)
    body.merge_vertices(digits_vertex=5)
    return body


def _simplified(faces: Faces) -> Faces:
    """Simplify faces if there are more than 500; the result has each triangle twice, once per side."""
    body = _welded(faces.corners)
    keep = np.flatnonzero(body.nondegenerate_faces() & body.unique_faces())
    if len(keep) <= HEAVY:
        return faces
    center, size = body.bounds.mean(axis=0), float(np.linalg.norm(body.extents))
    vertices = np.ascontiguousarray((np.asarray(body.vertices) - center) / size)
    for aggression in (5, 8, 12):
        points, triangles = fast_simplification.simplify(
            vertices, np.asarray(body.faces)[keep].astype(np.int32), target_count=LIGHT, agg=aggression
        )[:2]
        if len(triangles) <= 1.5 * LIGHT:
            break
    corners = (np.asarray(points, float) * size + center)[triangles]
    uv = np.zeros((len(corners), 3, 2))
    if faces.material.image is not None:
        middles = corners.mean(axis=1, keepdims=True)
        inner = (0.98 * corners + 0.02 * middles).reshape(-1, 3)  # so that all corners find the same chart
        origin = trimesh.Trimesh(
            faces.corners.reshape(-1, 3), np.arange(len(body.faces) * 3).reshape(-1, 3), process=False
        )
        origin.update_faces(keep)
        spot, _, nearest = trimesh.proximity.closest_point(origin, inner)
        weights = trimesh.triangles.points_to_barycentric(origin.triangles[nearest], spot)
        uv = np.einsum("nc,ncd->nd", weights, faces.uv[keep][nearest]).reshape(-1, 3, 2)
    return Faces(np.concatenate([corners, corners[:, ::-1]]), np.concatenate([uv, uv[:, ::-1]]), faces.material)


def _tiles(corners: Array, uv: Array, image: Image.Image) -> tuple[list[_Tile], Array, Array]:
    """Find the rectangles of a texture that faces use.

    Args:
        corners: (F, 3, 3) corners of the faces, m.
        uv: (F, 3, 2) texture coordinates of the corners.
        image: the texture.

    Returns:
        The tiles, the index (F,) of the tile of each face, and the position (F, 3, 2) of each corner in its tile, 0..1.
    """
    charts = _charts(corners, uv)
    count = int(charts.max()) + 1
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    np.minimum.at(low, charts, uv.min(axis=1))
    np.maximum.at(high, charts, uv.max(axis=1))
    shift = np.floor(low)
    low = np.floor((low - shift) * GRID + 1e-3) / GRID
    high = np.maximum(np.ceil((high - shift) * GRID - 1e-3) / GRID, low + 1 / GRID)
    area = np.bincount(charts, _areas(corners), count)
    spread = np.bincount(charts, _areas(np.concatenate([uv, np.zeros_like(uv[..., :1])], axis=2)), count)
    scale = np.minimum(1.0, DENSITY * np.sqrt(area / np.maximum(spread, 1e-9)) / max(image.size))
    tiles: list[_Tile] = []
    taken = np.zeros((0, 5))
    tile_of = np.zeros(count, int)
    for chart in np.argsort(-np.round((high - low).prod(axis=1) * scale**2, 9), kind="stable"):
        fits = (taken[:, :2] <= low[chart]).all(axis=1) & (taken[:, 2:4] >= high[chart]).all(axis=1)
        fits &= taken[:, 4] >= ENOUGH * scale[chart]
        if not fits.any():
            ends = tuple(low[chart].tolist()), tuple(high[chart].tolist())
            tiles.append(_Tile(image=image, low=ends[0], high=ends[1], scale=float(scale[chart])))
            taken = np.vstack([taken, [*low[chart], *high[chart], scale[chart]]])
            fits = np.append(fits, True)
        tile_of[chart] = int(fits.argmax())
    index = tile_of[charts]
    start, stop = taken[index, None, :2], taken[index, None, 2:4]
    return tiles, index, ((uv - shift[charts][:, None]) - start) / (stop - start)


def _charts(corners: Array, uv: Array) -> Array:
    """Return the number (F,) of the chart of each face; a chart has common corners in 3D and UV."""
    keys = np.round(np.concatenate([corners, uv], axis=2).reshape(-1, 5) * 1e4).astype(np.int64)
    nodes = np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1, 3)
    links = np.concatenate([nodes[:, [0, 1]], nodes[:, [1, 2]]])
    size = int(nodes.max()) + 1
    graph = coo_matrix((np.ones(len(links)), (links[:, 0], links[:, 1])), (size, size))
    return np.unique(connected_components(graph, directed=False)[1][nodes[:, 0]], return_inverse=True)[1]


def _areas(corners: Array) -> Array:
    sides = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return np.linalg.norm(np.cross(*sides), axis=1) / 2


def _packed(tiles: Sequence[_Tile]) -> tuple[Image.Image, Array]:
    """Pack tiles into one image.

    Returns:
        The image, and the box (T, 4) of each tile in pixels: left, top, width, height, without padding.
    """
    shrink = 1.0
    while True:
        sizes = np.array([tile.size(shrink) for tile in tiles])
        boxes, height, width = _shelves(sizes)
        if height <= SIDE and width <= SIDE:
            break
        shrink *= 0.9
        if shrink < 0.01:
            raise AssetError(
                "the textures of a link do not fit into one image",
                expected=f"an image of at most {SIDE} x {SIDE} pixels",
                found=f"{len(tiles)} pieces of textures",
                fix="Reduce the number of materials of the model.",
            )
    texture_image = Image.new("RGB", (width, height))
    for tile, (left, top, across, down) in zip(tiles, boxes.astype(int).tolist(), strict=True):
        texture_image.paste(tile.draw(across, down), (left - PADDING, top - PADDING))
    return texture_image, boxes


def _shelves(sizes: Array) -> tuple[Array, int, int]:
    """Arrange boxes in rows, tallest first.

    Args:
        sizes: (T, 2) width and height of each box, pixels.

    Returns:
        Left, top, width and height (T, 4) of each box, and the height and the width of the whole image.
    """
    outer = sizes + 2 * PADDING
    width = int(max(outer[:, 0].max(), min(SIDE, 2 ** np.ceil(np.log2(np.sqrt(outer.prod(axis=1).sum()))))))
    boxes, left, top, row = np.zeros((len(sizes), 4)), 0, 0, 0
    for index in np.lexsort((-outer[:, 0], -outer[:, 1])):
        if left + outer[index, 0] > width:
            left, top, row = 0, top + row, 0
        boxes[index] = (left + PADDING, top + PADDING, *sizes[index])
        left, row = left + int(outer[index, 0]), max(row, int(outer[index, 1]))
    return boxes, top + row, width


@lru_cache(maxsize=16)
def _opened(path: Path) -> Image.Image:
    return open_texture(read_file(path, path.parent), path, [])
