"""Make objects from coloured parts, which are blended, unwrapped and painted without seams."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import trimesh
import xatlas
from PIL import Image
from scipy.ndimage import distance_transform_edt

from asset_tools.builtin.blends import Field, Point, mesh_field, smooth_min
from asset_tools.builtin.mesh import Shape, Size, make_creased_shape
from asset_tools.builtin.textures import Colour, encode_jpeg
from asset_tools.decompose import reduce_hull_vertices

MM = 1e-3
CREASE_DEG = 55.0  # simplified roundings are coarse
OVERSAMPLING = 2
SHADE = 0.3  # fraction by which the deepest creases are darker

Box = tuple[Point, Point]
# points (n, 3) mm, unit normals (n, 3), colours (n, 3) to change in place
Decorate = Callable[[np.ndarray, np.ndarray, np.ndarray, np.random.Generator], None]


@dataclass(frozen=True)
class Part:
    """A part of a model.

    Args:
        field: signed distance field of the part, mm.
        colour: colour of the part.
        soft: width of the rounded transition to the previous parts, mm.
    """

    field: Field
    colour: Colour
    soft: float = 0.0


@dataclass(frozen=True)
class Model:
    """An object that is a union of parts; lengths in mm.

    Args:
        parts: parts in the order of the union. Each point of the surface has the colour of the nearest part.
        low: lower corner of a box that contains the object.
        high: upper corner of this box.
        decorate: function that paints details over the colours of the parts.
        floor: height at which the object is cut off to get a flat base; None: not cut.
        step: grid spacing of the mesh.
        triangles: approximate number of triangles of the mesh.
        texture_size: width and height of the texture in pixels.
        hulls: boxes (lower corner, upper corner). The part of the object in each box becomes a convex collision piece.
        grain: amplitude of the variation of brightness, as a fraction.
    """

    parts: tuple[Part, ...]
    low: Point
    high: Point
    decorate: Decorate | None = None
    floor: float | None = None
    step: float = 1.0
    triangles: int = 2000
    texture_size: int = 512
    hulls: tuple[Box, ...] = ()
    grain: float = 0.02

    def field(self, points: np.ndarray) -> np.ndarray:
        """Return the signed distances (n,) of points (n, 3) from the surface of the whole object, mm."""
        distance = self.parts[0].field(points)
        for part in self.parts[1:]:
            distance = smooth_min(distance, part.field(points), part.soft)
        return distance if self.floor is None else np.maximum(distance, self.floor - points[:, 2])

    @cached_property
    def body(self) -> trimesh.Trimesh:
        """Closed mesh of the object, mm."""
        body = mesh_field(self.field, self.low, self.high, step=self.step, triangles=self.triangles)
        if self.floor is not None:  # simplifying moves the rim a little
            low = body.vertices[:, 2] < self.floor + 0.3
            body.vertices[low, 2] = self.floor
        return body

    def shape(self, size: Size) -> Shape:
        """Return the body as a shape, centred and scaled along each axis to an exact size (x, y, z) in m.

        Raises:
            ValueError: the size along an axis would change by more than 20 %.
        """
        factor = np.asarray(size) / (self.body.extents * MM)
        if np.abs(factor - 1).max() > 0.2:
            raise ValueError(f"the parts do not fit the shape: expected {size} m, found {self.body.extents * MM} m")
        points = (self.body.vertices - self.body.bounds.mean(0)) * MM * factor
        pieces = tuple(
            reduce_hull_vertices((piece - self.body.bounds.mean(0)) * MM * factor) for piece in self._pieces()
        )
        return make_uv_mapped_shape(np.asarray(points), np.asarray(self.body.faces), self.texture_size, pieces)

    def paint(self, shape: Shape, rng: np.random.Generator) -> Image.Image:
        """Paint the colours of the parts on a shape made by `shape`, and return the texture."""
        extents = np.ptp(shape.vertices, axis=0)
        back, middle = self.body.extents / extents, self.body.bounds.mean(0)
        palette = np.array([part.colour for part in self.parts], np.float32)

        def colours(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
            points = (points * back + middle).astype(np.float32)
            nearest = np.argmin([part.field(points) for part in self.parts], axis=0)
            result = palette[nearest]
            if self.decorate is not None:
                self.decorate(points, normals, result, rng)
            reach = 0.03 * float(self.body.extents.max())
            open_ = np.clip(self.field((points + reach * normals).astype(np.float32)) / reach, 0, 1)
            shade = 1 - SHADE * (1 - open_) ** 1.5
            if self.grain:
                shade *= 1 + self.grain * _grain(points, rng)
            return result * shade[:, None]

        return paint_in_space(shape, colours)

    def _pieces(self) -> list[np.ndarray]:
        """Return the points (k, 3) of each convex collision piece, mm: the part of the object in each box."""
        import manifold3d

        solid = manifold3d.Manifold(
            manifold3d.Mesh(np.asarray(self.body.vertices, np.float32), np.asarray(self.body.faces, np.uint32))
        )
        pieces = []
        for low, high in self.hulls:
            tool = manifold3d.Manifold.cube(tuple(np.subtract(high, low).tolist())).translate(low)
            inside = (solid ^ tool).to_mesh()
            pieces.append(np.asarray(inside.vert_properties[:, :3], float))
        return pieces


def make_box_pair(low: Point, high: Point) -> tuple[Box, Box]:
    """Return a box, given by its lower and upper corner, and its mirror image at the plane y = 0."""
    return (low, high), ((low[0], -high[1], low[2]), (high[0], -low[1], high[2]))


def make_uv_mapped_shape(
    vertices: np.ndarray, faces: np.ndarray, texture_size: int, pieces: tuple[np.ndarray, ...] = ()
) -> Shape:
    """Unwrap a closed surface and return it as a shape, whose triangles do not overlap in the texture.

    Parts of the texture may be mirrored. This does not matter for `paint_in_space`.

    Args:
        vertices: (n, 3) vertices, m.
        faces: (f, 3) indices of vertices.
        texture_size: width and height of the texture in pixels.
        pieces: points (k, 3) of each convex collision piece, m.
    """
    low, reach = vertices.min(0), float(np.ptp(vertices, axis=0).max())
    atlas = xatlas.Atlas()
    atlas.add_mesh(((vertices - low) / reach).astype(np.float32), faces.astype(np.uint32))
    options = xatlas.PackOptions()
    options.resolution, options.padding, options.bilinear = texture_size, 3, True
    atlas.generate(pack_options=options)
    origin, corners, uv = atlas[0]
    uv, corners = uv.astype(float), corners.astype(np.int64)
    return make_creased_shape(vertices[origin], uv, corners, texture_size, pieces, crease_deg=CREASE_DEG)


def paint_in_space(shape: Shape, colours: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Image.Image:
    """Paint the texture of a shape from a function that returns the colour at each point in space.

    Args:
        shape: shape whose triangles do not overlap in the texture.
        colours: function of points (n, 3) in m and normals (n, 3) that returns colours (n, 3) in 0..255.
    """
    size = OVERSAMPLING * shape.texture_size
    row, column, face, weights = _texels(shape.uv[shape.faces], size)
    corners = shape.faces[face]
    points = np.einsum("nc,ncd->nd", weights, shape.vertices[corners])
    normals = np.einsum("nc,ncd->nd", weights, shape.normals[corners])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    pixels = np.zeros((size, size, 3), np.uint8)
    empty = np.ones((size, size), bool)
    pixels[row, column] = np.clip(np.rint(colours(points, normals)), 0, 255)
    empty[row, column] = False
    near = distance_transform_edt(empty, return_distances=False, return_indices=True)
    return encode_jpeg(Image.fromarray(pixels[near[0], near[1]]).reduce(OVERSAMPLING), 85)  # type: ignore[index]


def _texels(uv: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Find the texels whose centres are in a face.

    Args:
        uv: (f, 3, 2) texture coordinates of the corners of each face.
        size: width and height of the texture in pixels.

    Returns:
        Row (n,), column (n,), face (n,) and barycentric weights (n, 3) of each texel.
    """
    corners = uv * (size, -size) + (-0.5, size - 0.5)  # column, row; whole numbers are centres
    low = np.clip(np.ceil(corners.min(1)), 0, size - 1).astype(int)
    count = np.maximum(np.clip(np.floor(corners.max(1)), 0, size - 1).astype(int) - low + 1, 0)
    many = count.prod(1)
    face = np.repeat(np.arange(len(uv)), many)
    step = np.arange(len(face)) - np.repeat(np.cumsum(many) - many, many)
    wide = np.maximum(count[face, 0], 1)
    column, row = low[face, 0] + step % wide, low[face, 1] + step // wide
    a, b, c = corners[face].transpose(1, 0, 2)
    texel = np.column_stack([column, row])
    area = _cross(b - a, c - a)
    area = np.where(np.abs(area) < 1e-12, np.inf, area)
    weights = np.column_stack(
        [_cross(b - texel, c - texel), _cross(c - texel, a - texel), _cross(a - texel, b - texel)]
    )
    weights = weights / area[:, None]
    keep = (weights >= -1e-6).all(1) & np.isfinite(area)
    return row[keep], column[keep], face[keep], weights[keep]


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def _grain(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return smooth noise (n,) in about [-1, 1] at points (n, 3) in mm; its waves are a few cm long."""
    waves = rng.normal(size=(6, 3)) * 0.12
    return np.cos(points @ waves.T + rng.uniform(0, 2 * np.pi, 6)).sum(1) / np.sqrt(6)
