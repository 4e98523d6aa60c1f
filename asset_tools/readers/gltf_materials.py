"""Convert materials of a glTF file to one image and one colour: base colour plus emission."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from asset_tools.readers import gltf_schema as schema
from asset_tools.readers.gltf_buffers import Buffers, entry
from asset_tools.readers.images import open_texture
from asset_tools.readers.surface import Material, decode_srgb, encode_srgb

Array = NDArray[np.float64]

READ_EXTENSIONS = {
    "KHR_mesh_quantization",
    "KHR_texture_transform",
    "KHR_materials_pbrSpecularGlossiness",
    "KHR_materials_emissive_strength",
    "KHR_materials_unlit",
    "EXT_texture_webp",
}
BLACK = 0.02  # linear; darker base colours show nothing


@dataclass(frozen=True)
class TextureMapping:
    """How an image is laid over a surface.

    Attributes:
        uv_set: the number N of ``TEXCOORD_N``.
        transform: of the coordinates, v downward: ((a, b, shift), (c, d, shift)).
        wrap: how the image continues across and down: repeated, mirrored, or by its edges.
    """

    uv_set: int
    transform: tuple[tuple[float, float, float], tuple[float, float, float]] = ((1, 0, 0), (0, 1, 0))
    wrap: tuple[int, int] = (schema.REPEAT, schema.REPEAT)

    def apply(self, uvs: Array) -> Array:
        """Return transformed coordinates (V, 2)."""
        matrix = np.array(self.transform)
        return uvs @ matrix[:, :2].T + matrix[:, 2]

    def repeating(self, image: Image.Image, uvs: Array) -> tuple[Image.Image, Array]:
        """Return an image and coordinates that show the same where images repeat."""
        for axis, wrap in enumerate(self.wrap):
            image, uvs[:, axis] = _repeating(image, uvs[:, axis], wrap, axis)
        return image, uvs


@dataclass(frozen=True, eq=False)
class MappedImage:
    """An image, and where it is shown."""

    image: Image.Image
    mapping: TextureMapping


class Materials:
    """The materials of a glTF file.

    Args:
        model: the JSON.
        buffers: reads the images.
        notes: gets a line per texture that was shrunk.
        ignored: gets what a viewer would show and is left out.
    """

    def __init__(self, model: schema.Gltf, buffers: Buffers, notes: list[str], ignored: set[str]) -> None:
        self._model, self._buffers, self._notes, self._ignored = model, buffers, notes, ignored
        self._images: dict[int, Image.Image] = {}
        self._materials: dict[tuple[int, frozenset[int]], tuple[Material, TextureMapping]] = {}

    def material(self, index: int | None, uv_sets: frozenset[int]) -> tuple[Material, TextureMapping]:
        """Return a material, and how its image is laid over a mesh.

        Args:
            index: of the material; None: white.
            uv_sets: that the mesh has; an image on another one is left out.
        """
        if index is None:
            return Material(), TextureMapping(0)
        if (index, uv_sets) not in self._materials:
            self._materials[index, uv_sets] = self._read(entry(self._model.materials, index, "materials"), uv_sets)
        return self._materials[index, uv_sets]

    def _read(self, material: schema.Material, uv_sets: frozenset[int]) -> tuple[Material, TextureMapping]:
        shading = material.pbrMetallicRoughness
        factor, info = shading.baseColorFactor, shading.baseColorTexture
        if "KHR_materials_pbrSpecularGlossiness" in material.extensions:
            older = schema.SpecularGlossiness.model_validate(material.extensions["KHR_materials_pbrSpecularGlossiness"])
            factor, info = older.diffuseFactor, older.diffuseTexture
        if shading.metallicRoughnessTexture or material.normalTexture or material.occlusionTexture:
            self._ignored.add("normal, roughness or occlusion maps")
        if material.alphaMode != "OPAQUE":
            self._ignored.add("transparency")
        self._ignored |= {f"the extension {name}" for name in material.extensions if name not in READ_EXTENSIONS}
        color = np.array(factor[:3])
        base = None if info is None else self._image(info, uv_sets)
        strength = schema.EmissiveStrength.model_validate(
            material.extensions.get("KHR_materials_emissive_strength", {})
        )
        glow = np.clip(np.array(material.emissiveFactor) * strength.emissiveStrength, 0, 1)
        light = None
        if material.emissiveTexture is not None and glow.any():
            light = self._image(material.emissiveTexture, uv_sets)
            if light is None:
                glow = np.zeros(3)
        return self._combined(base, color, light, glow)

    def _combined(
        self, base: MappedImage | None, color: Array, light: MappedImage | None, glow: Array
    ) -> tuple[Material, TextureMapping]:
        """Return the sum of base colour and emitted light; each is an image (None: white) times a linear colour."""
        if light is not None and color.max() < BLACK:
            return Material(_triple(glow), light.image), light.mapping
        if not glow.any() or (base is not None and light is not None and base.mapping != light.mapping):
            if glow.any():
                self._ignored.add("an emissive texture laid out in another way than the base colour")
            return Material(_triple(color), base and base.image), base.mapping if base else TextureMapping(0)
        shown = base or light
        if shown is None:
            return Material(_triple(color + glow)), TextureMapping(0)
        total: Array | float = 0.0
        for mapped, tint in ((base, color), (light, glow)):
            pixels = None if mapped is None else np.asarray(mapped.image.resize(shown.image.size))
            total = total + (tint if pixels is None else decode_srgb(pixels) * tint)
        return Material(image=Image.fromarray(encode_srgb(np.asarray(total)))), shown.mapping

    def _image(self, info: schema.TextureInfo, uv_sets: frozenset[int]) -> MappedImage | None:
        texture = entry(self._model.textures, info.index, "textures")
        mapping = _mapping(info)
        if texture.sampler is not None:
            sampler = entry(self._model.samplers, texture.sampler, "samplers")
            mapping = replace(mapping, wrap=(sampler.wrapS, sampler.wrapT))
        if mapping.uv_set not in uv_sets:
            self._ignored.add(f"a texture without coordinates (TEXCOORD_{mapping.uv_set})")
            return None
        webp = texture.extensions.get("EXT_texture_webp")
        source = texture.source if webp is None else schema.Texture.model_validate(webp).source
        if source is None and texture.extensions:
            raise ValueError(f"the image of a texture is compressed ({', '.join(texture.extensions)})")
        if source is None:
            self._ignored.add("a texture without an image")
            return None
        if source not in self._images:
            image = entry(self._model.images, source, "images")
            if image.bufferView is not None:
                data, where = self._buffers.view(image.bufferView)[0], f"images.{source}"
            elif image.uri is not None:
                data, where = self._buffers.content(image.uri)
            else:
                raise ValueError(f"images.{source} has no data")
            self._images[source] = open_texture(data, where, self._notes)
        return MappedImage(self._images[source], mapping)


def _mapping(info: schema.TextureInfo) -> TextureMapping:
    extension = info.extensions.get("KHR_texture_transform")
    if extension is None:
        return TextureMapping(info.texCoord)
    found = schema.Transform.model_validate(extension)
    cos, sin = float(np.cos(found.rotation)), float(np.sin(found.rotation))
    (u, v), (across, down) = found.offset, found.scale
    # counter-clockwise as seen, v downward: as three.js and Khronos's viewer have it
    rows = (cos * across, sin * down, u), (-sin * across, cos * down, v)
    return TextureMapping(info.texCoord if found.texCoord is None else found.texCoord, rows)


def _triple(color: Array) -> tuple[float, float, float]:
    red, green, blue = (float(value) for value in np.clip(color, 0, 1))
    return red, green, blue


def _repeating(image: Image.Image, values: Array, wrap: int, axis: int) -> tuple[Image.Image, Array]:
    """Convert an image with another wrap mode along an axis (0: across) to a repeating image and coordinates.

    A mirrored image is joined to its mirror image. Edges continue for at most one width of the image.
    """
    if wrap not in (schema.MIRROR, schema.CLAMP) or len(values) == 0:
        return image, values
    pixels = np.asarray(image)
    size, along = image.size[axis], 1 - axis  # rows are the first axis of pixels
    if wrap == schema.MIRROR:
        return Image.fromarray(np.concatenate([pixels, np.flip(pixels, along)], axis=along)), values / 2
    margins = np.clip([-values.min(), values.max() - 1], 0, 1)
    before, after = np.ceil(margins * size).astype(int) + 1  # a pixel, so that opposite edges never mix
    widths = [(0, 0)] * 3
    widths[along] = (int(before), int(after))
    padded = np.pad(pixels, widths, mode="edge")
    inside = np.clip(values, -margins[0], 1 + margins[1])
    return Image.fromarray(padded), (inside * size + before) / padded.shape[along]
