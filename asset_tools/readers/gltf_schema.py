"""Pydantic models of the parts of a glTF 2.0 file that are read."""

# Names are the specification's.
# ruff: noqa: N815

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, NonNegativeInt
from scipy.spatial.transform import Rotation

from asset_tools.readers.obj import MOST_VERTICES

MOST_NODES = 100_000
TRIANGLES = 4
REPEAT, CLAMP, MIRROR = 10497, 33071, 33648


class Schema(BaseModel):
    """Base class of the models, which ignores unknown keys and rejects NaN and infinite values."""

    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)


class SparseIndices(Schema):
    """Indices of the values that a sparse accessor replaces."""

    bufferView: NonNegativeInt
    byteOffset: NonNegativeInt = 0
    componentType: Literal[5121, 5123, 5125]


class SparseValues(Schema):
    """Values that a sparse accessor puts at the indices."""

    bufferView: NonNegativeInt
    byteOffset: NonNegativeInt = 0


class SparseAccessor(Schema):
    """Values of an accessor that replace values of the buffer view: count, indices and new values."""

    count: NonNegativeInt
    indices: SparseIndices
    values: SparseValues


class Accessor(Schema):
    """A typed array in a buffer view."""

    bufferView: NonNegativeInt | None = None
    byteOffset: NonNegativeInt = 0
    componentType: Literal[5120, 5121, 5122, 5123, 5125, 5126]
    normalized: bool = False
    count: int = Field(ge=0, le=3 * MOST_VERTICES)
    type: Literal["SCALAR", "VEC2", "VEC3", "VEC4", "MAT2", "MAT3", "MAT4"]
    sparse: SparseAccessor | None = None


class BufferView(Schema):
    """A slice of a buffer."""

    buffer: NonNegativeInt
    byteOffset: NonNegativeInt = 0
    byteLength: NonNegativeInt
    byteStride: int | None = Field(default=None, ge=1, le=1024)
    extensions: dict[str, Any] = {}


class Buffer(Schema):
    """Bytes in a file, a data URI or the binary chunk."""

    uri: str | None = None


class Image(Schema):
    """An image in a file, a data URI or a buffer view."""

    uri: str | None = None
    bufferView: NonNegativeInt | None = None


class Sampler(Schema):
    """Wrap modes of an image for texture coordinates outside of 0..1."""

    wrapS: int = REPEAT
    wrapT: int = REPEAT


class Texture(Schema):
    """An image with a sampler."""

    source: NonNegativeInt | None = None
    sampler: NonNegativeInt | None = None
    extensions: dict[str, Any] = {}


class TextureInfo(Schema):
    """Reference to a texture, with the number of the UV set."""

    index: NonNegativeInt
    texCoord: NonNegativeInt = 0
    extensions: dict[str, Any] = {}


class TextureTransform(Schema):
    """The extension KHR_texture_transform: offset, rotation in rad and scale of texture coordinates."""

    offset: tuple[float, float] = (0.0, 0.0)
    rotation: float = 0.0
    scale: tuple[float, float] = (1.0, 1.0)
    texCoord: NonNegativeInt | None = None


class MetallicRoughness(Schema):
    """Base colour and roughness of a material in the metallic-roughness model."""

    baseColorFactor: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)
    baseColorTexture: TextureInfo | None = None
    metallicRoughnessTexture: TextureInfo | None = None


class SpecularGlossiness(Schema):
    """The extension KHR_materials_pbrSpecularGlossiness: diffuse colour of an older kind of material."""

    diffuseFactor: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)
    diffuseTexture: TextureInfo | None = None


class EmissiveStrength(Schema):
    """The extension KHR_materials_emissive_strength: factor of the emitted light."""

    emissiveStrength: float = 1.0


class Material(Schema):
    """A material: base colour, emitted light, and maps that are not read."""

    pbrMetallicRoughness: MetallicRoughness = MetallicRoughness()
    emissiveFactor: tuple[float, float, float] = (0.0, 0.0, 0.0)
    emissiveTexture: TextureInfo | None = None
    normalTexture: Any = None
    occlusionTexture: Any = None
    alphaMode: str = "OPAQUE"
    extensions: dict[str, Any] = {}


class Primitive(Schema):
    """Triangles, lines or points of one material."""

    attributes: dict[str, NonNegativeInt]
    indices: NonNegativeInt | None = None
    material: NonNegativeInt | None = None
    mode: int = TRIANGLES
    targets: list[Any] = []
    extensions: dict[str, Any] = {}


class Mesh(Schema):
    """A mesh: a list of primitives."""

    primitives: list[Primitive]
    weights: list[float] = []


class Node(Schema):
    """A node of the scene graph: pose, mesh and indices of the children."""

    mesh: NonNegativeInt | None = None
    skin: NonNegativeInt | None = None
    children: list[NonNegativeInt] = []
    matrix: list[float] | None = Field(default=None, min_length=16, max_length=16)
    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    extensions: dict[str, Any] = {}

    def transform(self) -> NDArray[np.float64]:
        """Return the pose (4, 4) of the node in the frame of its parent."""
        if self.matrix is not None:
            return np.array(self.matrix, float).reshape(4, 4).T
        pose = np.eye(4)
        turn = np.array(self.rotation) if np.linalg.norm(self.rotation) > 1e-9 else np.array([0.0, 0.0, 0.0, 1.0])
        pose[:3, :3] = Rotation.from_quat(turn).as_matrix() * np.array(self.scale)
        pose[:3, 3] = self.translation
        return pose


class Scene(Schema):
    """A scene: the indices of its root nodes."""

    nodes: list[NonNegativeInt] = []


class Gltf(Schema):
    """The JSON of a glTF file."""

    scene: NonNegativeInt = 0
    scenes: list[Scene] = []
    nodes: list[Node] = Field(default=[], max_length=MOST_NODES)
    meshes: list[Mesh] = []
    materials: list[Material] = []
    textures: list[Texture] = []
    images: list[Image] = []
    samplers: list[Sampler] = []
    accessors: list[Accessor] = []
    bufferViews: list[BufferView] = []
    buffers: list[Buffer] = []
    extensionsUsed: list[str] = []
    extensionsRequired: list[str] = []
