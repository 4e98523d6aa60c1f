"""Convert materials of a glTF file to one image and one colour: base colour plus emitted light."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from asset_tools.readers import gltf_schema as schema
from asset_tools.readers.gltf_buffers import BufferReader, get_entry
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
    """Mapping from the texture coordinates of a mesh to an image.

    Attributes:
        uv_set: number N of the vertex attribute ``TEXCOORD_N`` with the coordinates.
        transform: affine transform (2, 3) of the coordinates, v downward.
        wrap: wrap modes of glTF for u and v outside of 0..1: `REPEAT`, `MIRROR` or `CLAMP`.
    """

    uv_set: int
    transform: tuple[tuple[float, float, float], tuple[float, float, float]] = ((1, 0, 0), (0, 1, 0))
    wrap: tuple[int, int] = (schema.REPEAT, schema.REPEAT)

    def apply(self, uvs: Array) -> Array:
        """Return texture coordinates (V, 2) after the transform."""
        matrix = np.array(self.transform)
        return uvs @ matrix[:, :2].T + matrix[:, 2]

    def to_repeating(self, image: Image.Image, uvs: Array) -> tuple[Image.Image, Array]:
        """Return an image and coordinates (V, 2) that give equal colours with the wrap mode `REPEAT`.

        Args:
            image: texture image.
            uvs: (V, 2) coordinates after the transform, which are changed.
        """
        for axis, wrap in enumerate(self.wrap):
            image, uvs[:, axis] = _repeating(image, uvs[:, axis], wrap, axis)
        return image, uvs


@dataclass(frozen=True, eq=False)
class MappedImage:
    """A texture image and its mapping."""

    image: Image.Image
    mapping: TextureMapping


class MaterialReader:
    """Reader of the materials of a glTF file.

    Args:
        model: JSON of the file.
        buffers: reader of the binary data.
        notes: list to which one note per shrunk texture is appended.
        ignored: set to which the names of visible features that are not read are added.
    """

    def __init__(self, model: schema.Gltf, buffers: BufferReader, notes: list[str], ignored: set[str]) -> None:
        self._model, self._buffers, self._notes, self._ignored = model, buffers, notes, ignored
        self._images: dict[int, Image.Image] = {}
        self._materials: dict[tuple[int, frozenset[int]], tuple[Material, TextureMapping]] = {}

    def read_material(self, index: int | None, uv_sets: frozenset[int]) -> tuple[Material, TextureMapping]:
        """Return a material and the mapping of its image.

        Args:
            index: index of the material; None: the mesh has no material and is white.
            uv_sets: numbers of the UV sets of the mesh; images that need another set are ignored.
        """
        if index is None:
            return Material(), TextureMapping(0)
        if (index, uv_sets) not in self._materials:
            self._materials[index, uv_sets] = self._read(get_entry(self._model.materials, index, "materials"), uv_sets)
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
        """Return the sum of base colour and emitted light as one material, and the mapping of its image.

        Args:
            base: image of the base colour; None: white.
            color: (3,) linear factor of ``base``.
            light: image of the emitted light; None: white.
            glow: (3,) linear factor of ``light``.
        """
        if light is not None and color.max() < BLACK:
            return Material(_triple(glow), light.image), light.mapping
        if not glow.any() or (base is not None and light is not None and base.mapping != light.mapping):
            if glow.any():
                self._ignored.add("an emissive texture with other texture coordinates than the base colour")
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
        texture = get_entry(self._model.textures, info.index, "textures")
        mapping = _mapping(info)
        if texture.sampler is not None:
            sampler = get_entry(self._model.samplers, texture.sampler, "samplers")
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
            image = get_entry(self._model.images, source, "images")
            if image.bufferView is not None:
                data, where = self._buffers.read_view(image.bufferView)[0], f"images.{source}"
            elif image.uri is not None:
                data, where = self._buffers.read_uri(image.uri)
            else:
                raise ValueError(f"images.{source} has neither a bufferView nor a uri")
            self._images[source] = open_texture(data, where, self._notes)
        return MappedImage(self._images[source], mapping)


def _mapping(info: schema.TextureInfo) -> TextureMapping:
    extension = info.extensions.get("KHR_texture_transform")
    if extension is None:
        return TextureMapping(info.texCoord)
    found = schema.TextureTransform.model_validate(extension)
    cos, sin = float(np.cos(found.rotation)), float(np.sin(found.rotation))
    (u, v), (across, down) = found.offset, found.scale
    # counter-clockwise as seen, v downward: as three.js and Khronos's viewer have it
    rows = (cos * across, sin * down, u), (-sin * across, cos * down, v)
    return TextureMapping(info.texCoord if found.texCoord is None else found.texCoord, rows)


def _triple(color: Array) -> tuple[float, float, float]:
    red, green, blue = (float(value) for value in np.clip(color, 0, 1))
    return red, green, blue


def _repeating(image: Image.Image, values: Array, wrap: int, axis: int) -> tuple[Image.Image, Array]:
    """Convert an image with any wrap mode to an image and coordinates for `REPEAT`, along one axis.

    An image with the mode `MIRROR` is joined to its mirror image. An image with the mode `CLAMP` is extended with the
    colours of its edges, at each side by at most its own size.

    Args:
        image: texture image.
        values: (V,) coordinates along the axis.
        wrap: wrap mode.
        axis: 0 for u, 1 for v.
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
