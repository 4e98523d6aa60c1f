"""Read the triangles, colours and textures of glTF 2.0 files (``.gltf`` and ``.glb``).

The reader follows the specification (registry.khronos.org/glTF) and the extensions in
`gltf_materials.READ_EXTENSIONS`. Other visible features are ignored with a warning.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from asset_tools.readers import gltf_schema as schema
from asset_tools.readers.files import ModelFiles
from asset_tools.readers.gltf_buffers import BufferReader, get_entry
from asset_tools.readers.gltf_materials import READ_EXTENSIONS, MaterialReader
from asset_tools.readers.obj import MOST_FACES
from asset_tools.readers.surface import Material, MeshPart
from robocas_ms3.core.documents import decode_json
from robocas_ms3.core.errors import AssetError
from robocas_ms3.core.text import one_line

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

COMPRESSED = {"KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression", "KHR_texture_basisu"}
LINES, STRIP, FAN = (0, 1, 2, 3), 5, 6


def read_gltf(path: Path, files: ModelFiles) -> list[MeshPart]:
    """Read a glTF file as one part per primitive.

    Args:
        path: path of the file.
        files: files of the model, which reads the file, its buffers and images; warnings are added to ``files.notes``.

    Raises:
        AssetError: the file is damaged or compressed, has wrong types, or needs a missing file.
    """
    tree, blob = _split(files.read(path), path)
    try:
        model = schema.Gltf.model_validate(tree)
    except ValidationError as error:
        first = error.errors()[0]
        raise _damaged(path, f"{'.'.join(map(str, first['loc'])) or 'file'}: {first['msg']}") from error
    compressed = sorted(COMPRESSED & set(model.extensionsRequired))
    if compressed:
        raise AssetError(
            "the file is compressed",
            where=path,
            expected="no compression",
            found=f"extensionsRequired {', '.join(compressed)}",
            fix="Export the mesh without compression.",
        )
    ignored = {f"the extension {name}" for name in set(model.extensionsRequired) - READ_EXTENSIONS}
    try:
        parts = _parts(model, blob, path, files, ignored)
    except ValidationError as error:
        raise _damaged(path, f"an extension: {error.errors()[0]['msg']}") from error
    except (ValueError, IndexError, OverflowError) as error:
        raise _damaged(path, one_line(error)) from error
    files.notes.extend(f"warning: {path.name}: ignored {what}" for what in sorted(ignored))
    return parts


def _split(data: bytes, path: Path) -> tuple[Any, bytes]:
    """Return the JSON value of a glTF file, and the binary chunk of a GLB file.

    The chunk of a .gltf file is empty.
    """
    blob, text = b"", data
    if data[:4] == b"glTF":
        if len(data) < 20:
            raise _damaged(path, "the file is truncated")
        version, _, length = struct.unpack_from("<III", data, 4)
        if version != 2:
            what, expected, found = "unsupported version of glTF", "version 2", f"version {version}"
            raise AssetError(what, where=path, expected=expected, found=found, fix="Export the mesh as glTF 2.0.")
        text, start = data[20 : 20 + length], 20 + length
        if start + 8 <= len(data):
            blob = data[start + 8 : start + 8 + struct.unpack_from("<I", data, start)[0]]
    try:
        return decode_json(text), blob
    except ValueError as error:
        raise _damaged(path, f"invalid JSON: {error}") from error


def _parts(model: schema.Gltf, blob: bytes, path: Path, files: ModelFiles, ignored: set[str]) -> list[MeshPart]:
    buffers = BufferReader(model, blob, path, files)
    materials = MaterialReader(model, buffers, files.notes, ignored)
    found: list[MeshPart] = []
    faces = 0
    for node, pose in _placed(model):
        if node.skin is not None:
            ignored.add("a skin")
        ignored |= {f"the extension {name}" for name in node.extensions if name == "EXT_mesh_gpu_instancing"}
        for primitive in get_entry(model.meshes, node.mesh, "meshes").primitives:
            if primitive.mode in LINES:
                ignored.add("points or lines")
                continue
            if primitive.targets:
                ignored.add("morph targets")
            part = _part(primitive, buffers, materials, ignored)
            faces += len(part.faces)
            if faces > MOST_FACES:
                expected = f"at most {MOST_FACES:,}"
                fix = "Reduce the number of faces."
                raise AssetError("the mesh has too many faces", where=path, expected=expected, fix=fix)
            found.append(_moved(part, pose))
    return found


def _placed(model: schema.Gltf) -> list[tuple[schema.Node, Array]]:
    """Return the nodes of the scene that have a mesh, and their poses (4, 4) in the frame of the scene."""
    children = {child for node in model.nodes for child in node.children}
    if model.scenes:
        roots = get_entry(model.scenes, model.scene, "scenes").nodes
    else:
        roots = [index for index in range(len(model.nodes)) if index not in children]
    found: list[tuple[schema.Node, Array]] = []
    seen: set[int] = set()
    queue = [(root, np.eye(4)) for root in reversed(roots)]
    while queue:
        index, parent = queue.pop()
        if index in seen:
            raise ValueError(f"nodes.{index} has two parents, expected at most one")
        seen.add(index)
        node = get_entry(model.nodes, index, "nodes")
        pose = parent @ node.transform()
        if node.mesh is not None:
            found.append((node, pose))
        queue.extend((child, pose) for child in reversed(node.children))
    return found


def _part(primitive: schema.Primitive, buffers: BufferReader, materials: MaterialReader, ignored: set[str]) -> MeshPart:
    """Return the triangles of a primitive in the frame of its node."""
    attributes = primitive.attributes
    if "POSITION" not in attributes:
        raise ValueError("a primitive has no POSITION attribute")
    compressed = COMPRESSED & set(primitive.extensions)
    if compressed and not buffers.has_data(attributes["POSITION"]):
        raise ValueError(f"the triangles are compressed ({', '.join(compressed)})")
    vertices = buffers.read_vectors(attributes["POSITION"], 3)
    if primitive.indices is None:
        faces = _triangles(np.arange(len(vertices)), primitive.mode)
    else:
        faces = _triangles(buffers.read_values(primitive.indices).reshape(-1).astype(np.int64), primitive.mode)
    if len(faces) and not 0 <= faces.min() <= faces.max() < len(vertices):
        raise ValueError(f"a face refers to vertex {int(faces.max())}, but there are only {len(vertices)} vertices")
    normals = buffers.read_vectors(attributes["NORMAL"], 3) if "NORMAL" in attributes else None
    colors = buffers.read_colors(attributes["COLOR_0"]) if "COLOR_0" in attributes else None
    uv_sets = {key.removeprefix("TEXCOORD_") for key in attributes if key.startswith("TEXCOORD_")}
    numbers = frozenset(int(key) for key in uv_sets if key.isascii() and key.isdigit())
    material, mapping = materials.read_material(primitive.material, numbers)
    uvs = None
    if material.image is not None:
        uvs = mapping.apply(buffers.read_coordinates(attributes[f"TEXCOORD_{mapping.uv_set}"]))
        if np.isfinite(uvs).all():
            image, uvs = mapping.to_repeating(material.image, uvs)
            material = material if image is material.image else Material(material.color, image)
        uvs[:, 1] = 1 - uvs[:, 1]
    for name, values in (("normals", normals), ("vertex colours", colors), ("texture coordinates", uvs)):
        if values is not None and len(values) != len(vertices):
            raise ValueError(f"the numbers of {name} ({len(values)}) and vertices ({len(vertices)}) differ")
    if "JOINTS_0" in attributes:
        ignored.add("a skin")
    return MeshPart(vertices, faces, uvs, colors, normals, material)


def _moved(part: MeshPart, pose: Array) -> MeshPart:
    """Transform a part from the frame of a node to the frame of the scene, and return it.

    If the pose mirrors the part, the faces are flipped so that they stay oriented outwards.

    Args:
        part: the part, which is changed.
        pose: (4, 4) pose of the node in the frame of the scene.
    """
    linear = pose[:3, :3]
    part.vertices = part.vertices @ linear.T + pose[:3, 3]
    if part.normals is not None:
        turned = part.normals @ np.linalg.pinv(linear)
        part.normals = turned / np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-12)
    with np.errstate(over="ignore"):  # extreme scales are reported by the size check
        mirrored = np.linalg.det(linear) < 0
    if mirrored:
        part.faces = part.faces[:, ::-1]
    return part


def _triangles(indices: Ints, mode: int) -> Ints:
    if mode not in (STRIP, FAN):
        return indices[: len(indices) // 3 * 3].reshape(-1, 3)
    if len(indices) < 3:
        return np.zeros((0, 3), np.int64)
    if mode == FAN:
        return np.column_stack([np.full(len(indices) - 2, indices[0]), indices[1:-1], indices[2:]])
    faces = np.column_stack([indices[:-2], indices[1:-1], indices[2:]])
    faces[1::2] = faces[1::2][:, [1, 0, 2]]  # every second triangle of a strip has the opposite orientation
    return faces


def _damaged(path: Path, found: str) -> AssetError:
    found = found if len(found) <= 200 else f"{found[:200]}..."
    fix = "Export the mesh again, without compression." if "compressed" in found else "Export the mesh again."
    return AssetError("cannot read this mesh", where=path, found=found, fix=fix)
