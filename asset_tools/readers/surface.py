"""Represent models of all formats as parts with one material each, and join the parts to one mesh.

Colours are linear in 0..1, as in glTF; images and 8-bit colours are sRGB. Transparency is dropped.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image
from trimesh.visual.color import ColorVisuals
from trimesh.visual.material import Material as TrimeshMaterial
from trimesh.visual.material import SimpleMaterial
from trimesh.visual.texture import TextureVisuals

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

WHITE = (1.0, 1.0, 1.0)
TEXTURE, TINT = "texture", "tint"  # vertex attributes of a mesh with several textures


@dataclass(frozen=True, eq=False)
class Material:
    """Material of faces: an image multiplied by a colour.

    Attributes:
        color: linear RGB colour, 0 to 1.
        image: sRGB image; None: the faces have only the colour.
    """

    color: tuple[float, float, float] = WHITE
    image: Image.Image | None = None


@dataclass(eq=False)
class MeshPart:
    """Triangles of one material.

    Attributes:
        vertices: (V, 3) positions in the frame and unit of the model.
        faces: (F, 3) indices of vertices.
        uvs: (V, 2) texture coordinates, v upward, or None.
        colors: (V, 3) linear colours by which the material is multiplied; None: white.
        normals: (V, 3) unit normals from the file, or None.
        material: material of all faces.
    """

    vertices: Array
    faces: Ints
    uvs: Array | None = None
    colors: Array | None = None
    normals: Array | None = None
    material: Material = field(default_factory=Material)


class MultiTextureMaterial(TrimeshMaterial):
    """Material of a mesh with several texture images, or with an image that is multiplied by colours.

    A mesh with this material has two vertex attributes: `TEXTURE` (V,) is the index of the image, and `TINT` (V, 3) is
    the linear RGB factor.
    """

    def __init__(self, images: Sequence[Image.Image]) -> None:
        self.images = tuple(images)
        self.name = "textures"

    @property
    def main_color(self) -> NDArray[np.uint8]:
        """White, RGBA (4,) in 0..255, since the colours are in the images."""
        return np.full(4, 255, np.uint8)

    def copy(self) -> MultiTextureMaterial:
        """Return this material without a copy, since it is never changed."""
        return self

    def __hash__(self) -> int:
        """Return a hash of the identities of the images."""
        return hash(tuple(map(id, self.images)))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, MultiTextureMaterial) and other.images == self.images


def join_parts(parts: Sequence[MeshPart]) -> trimesh.Trimesh:
    """Join parts to one mesh with the colours of the parts.

    ``mesh.visual`` depends on the parts. If all parts are white, it is undefined. If no part has an image, it has sRGB
    vertex colours. If all parts have one image and no other colours, it has a ``SimpleMaterial``. Otherwise it has a
    `MultiTextureMaterial`.
    """
    parts = [part for part in parts if len(part.faces)]
    if not parts:
        return trimesh.Trimesh()
    offsets = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])
    vertices = np.concatenate([part.vertices for part in parts])
    faces = np.concatenate([part.faces + offset for part, offset in zip(parts, offsets, strict=True)])
    normals = None
    if all(part.normals is not None for part in parts):
        normals = np.concatenate([part.normals for part in parts if part.normals is not None])
    mesh = trimesh.Trimesh(vertices, faces, vertex_normals=normals, process=False)
    tints = np.concatenate([_tint(part) for part in parts])
    images = list({id(image): image for part in parts if (image := _image(part)) is not None}.values())
    if not images:
        if (tints != 1).any():
            mesh.visual = ColorVisuals(vertex_colors=encode_srgb(tints))
        return mesh
    uvs = np.concatenate([np.zeros((len(part.vertices), 2)) if part.uvs is None else part.uvs for part in parts])
    if len(images) == 1 and all(_image(part) is not None for part in parts) and (tints == 1).all():
        mesh.visual = TextureVisuals(uv=uvs, material=SimpleMaterial(image=images[0]))
        return mesh
    if any(_image(part) is None for part in parts):
        images.append(Image.new("RGB", (1, 1), (255, 255, 255)))
    place = {id(image): i for i, image in enumerate(images)}
    which = [np.full(len(part.vertices), place.get(id(_image(part)), len(images) - 1)) for part in parts]
    mesh.visual = TextureVisuals(uv=uvs, material=MultiTextureMaterial(images))
    mesh.vertex_attributes[TEXTURE] = np.concatenate(which)
    mesh.vertex_attributes[TINT] = tints
    return mesh


def decode_srgb(values: NDArray) -> Array:
    """Convert sRGB colours (...) in 0..255 to linear colours (...) in 0..1."""
    share = np.asarray(values, dtype=float) / 255
    return np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)


def encode_srgb(values: Array) -> NDArray[np.uint8]:
    """Convert linear colours (...) in 0..1 to 8-bit sRGB colours (...) in 0..255."""
    linear = np.clip(values, 0, 1)
    share = np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.rint(255 * share).astype(np.uint8)


def _image(part: MeshPart) -> Image.Image | None:
    return None if part.uvs is None else part.material.image


def _tint(part: MeshPart) -> Array:
    tint = np.tile(np.asarray(part.material.color, float), (len(part.vertices), 1))
    return tint if part.colors is None else tint * part.colors
