"""Write GLB files of visual meshes deterministically, and read properties of materials."""

from __future__ import annotations

import io
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from trimesh.visual.color import to_rgba
from trimesh.visual.material import PBRMaterial

from robocas_ms3.core.errors import AssetError
from robocas_ms3.core.files import atomic_file

DEFAULT_ROUGHNESS = 0.6
JPEG_QUALITY = 88


def write_glb(mesh: trimesh.Trimesh, path: Path | str) -> None:
    """Write a mesh as a GLB file with a JPEG texture; deterministic.

    Args:
        mesh: result of `visual.make_display_mesh`.
        path: path of the file.

    Raises:
        AssetError: the mesh has no ``PBRMaterial``.
    """
    material = getattr(mesh.visual, "material", None)
    if not isinstance(material, PBRMaterial):
        raise AssetError(
            "cannot write this mesh as GLB", where=path, expected="a PBRMaterial", fix="Use make_display_mesh first."
        )
    vertices = np.asarray(mesh.vertices, dtype="<f4")
    normals = np.asarray(mesh.vertex_normals, dtype="<f4")
    indices = np.asarray(mesh.faces, dtype="<u2" if len(vertices) < 65535 else "<u4").reshape(-1)
    views: list[dict] = []
    blob = bytearray()

    def add_view(data: bytes, **more: int) -> int:
        views.append({"buffer": 0, "byteOffset": len(blob), "byteLength": len(data), **more})
        blob.extend(data + b"\0" * (-len(data) % 4))
        return len(views) - 1

    limits = {"min": vertices.min(axis=0).tolist(), "max": vertices.max(axis=0).tolist()}
    float_view = {"componentType": 5126, "count": len(vertices)}
    whole = {"componentType": 5123 if indices.itemsize == 2 else 5125, "count": len(indices), "type": "SCALAR"}
    accessors = [
        {"bufferView": add_view(vertices.tobytes(), target=34962), **float_view, "type": "VEC3", **limits},
        {"bufferView": add_view(normals.tobytes(), target=34962), **float_view, "type": "VEC3"},
        {"bufferView": add_view(indices.tobytes(), target=34963), **whole},
    ]
    shading: dict[str, Any] = {
        "baseColorFactor": (get_rgba(material.baseColorFactor) / 255).tolist(),
        "metallicFactor": float(material.metallicFactor or 0),
        "roughnessFactor": get_roughness(material),
    }
    primitive = {"attributes": {"POSITION": 0, "NORMAL": 1}, "indices": 2, "material": 0}
    tree: dict = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}]}
    uv = getattr(mesh.visual, "uv", None)
    if material.baseColorTexture is not None and uv is not None:
        flipped = np.column_stack([uv[:, 0], 1 - uv[:, 1]]).astype("<f4")  # in glTF, v = 0 is the top
        accessors.append({"bufferView": add_view(flipped.tobytes(), target=34962), **float_view, "type": "VEC2"})
        primitive["attributes"]["TEXCOORD_0"] = 3
        jpeg = io.BytesIO()
        material.baseColorTexture.convert("RGB").save(jpeg, format="JPEG", quality=JPEG_QUALITY, optimize=True)
        shading["baseColorTexture"] = {"index": 0}
        tree["images"] = [{"bufferView": add_view(jpeg.getvalue()), "mimeType": "image/jpeg"}]
        tree["textures"] = [{"source": 0}]
    tree |= {
        "meshes": [{"primitives": [primitive]}],
        "materials": [{"pbrMetallicRoughness": shading}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(blob)}],
    }
    head = json.dumps(tree, separators=(",", ":")).encode()
    head += b" " * (-len(head) % 4)
    start = struct.pack("<4sIII4s", b"glTF", 2, 28 + len(head) + len(blob), len(head), b"JSON")
    with atomic_file(path) as tmp:
        tmp.write_bytes(start + head + struct.pack("<I4s", len(blob), b"BIN\0") + blob)


def get_roughness(material: Any) -> float:
    """Return the roughness of a material in 0..1; 0.6 if the material has none."""
    value = getattr(material, "roughnessFactor", None)
    return DEFAULT_ROUGHNESS if value is None else float(value)


def get_rgba(color: Any) -> NDArray[np.float64]:
    """Convert a colour to RGBA (4,) in 0..255; None is white."""
    return np.asarray((255,) * 4 if color is None else to_rgba(color), dtype=float)
