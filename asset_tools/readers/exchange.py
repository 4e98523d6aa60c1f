"""Read PLY, STL, OFF, COLLADA and 3MF files with trimesh."""

from __future__ import annotations

import io
import logging
import re
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image
from trimesh.resolvers import Resolver
from trimesh.visual.material import PBRMaterial

from asset_tools.readers.files import LARGEST_FILE, ModelFiles
from asset_tools.readers.images import open_texture
from asset_tools.readers.obj import MOST_FACES, MOST_VERTICES, decode_text
from asset_tools.readers.surface import Material, MeshPart, decode_srgb
from robocas_ms3.core.errors import AssetError, require_extra
from robocas_ms3.core.text import format_error

TEXTURE_COMMENT = re.compile(rb"comment\s+TextureFile\s+(.*)", re.IGNORECASE)
PLY_UVS = {b"s", b"t", b"u", b"v", b"texture_u", b"texture_v", b"texcoord"}
PLY_COLORS = {b"diffuse_red": b"red", b"diffuse_green": b"green", b"diffuse_blue": b"blue"}
LONGEST_HEADER = 65536  # bytes of a PLY file
BLACK = 0.02  # linear


def read_exchange(path: Path, files: ModelFiles) -> list[MeshPart]:
    """Read a PLY, STL, OFF, COLLADA or 3MF file as one part per mesh.

    Args:
        path: path of the file.
        files: files of the model, which reads the file and its textures; warnings are added to ``files.notes``.

    Raises:
        AssetError: the file is damaged or too large, or a texture is missing.
        MissingExtraError: the file is COLLADA, and pycollada is not installed.
    """
    data, suffix = files.read(path), path.suffix.lower()[1:]
    if suffix == "dae":
        require_extra("assets", "COLLADA files", "collada")
    if suffix == "3mf":
        _check_archive(data, path, files)
    textures, faces = _Textures(path, files), 0
    if suffix == "ply":
        data, faces = _ply_checked(data, path, textures)
    elif suffix == "off":
        faces = _off_faces(data, path, files)
    try:
        with _quiet():
            scene = trimesh.load_scene(io.BytesIO(data), suffix, resolver=textures, process=False)
        parts = [part for part in _parts(scene, textures) if len(part.faces)]
    except AssetError:
        raise
    except Exception as error:  # trimesh's parsers may raise any error
        found = format_error(error, 200)
        raise AssetError("cannot read this mesh", where=path, found=found, fix="Export the mesh again.") from error
    if textures.error is not None:
        raise textures.error
    count = sum(len(part.faces) for part in parts)
    if count < faces:
        found, fix = f"{count} faces", "Copy the file or export the mesh again."
        raise AssetError("the file is truncated", where=path, expected=f"{faces} faces", found=found, fix=fix)
    if count > MOST_FACES:
        expected = f"at most {MOST_FACES:,}"
        fix = "Reduce the number of faces."
        raise AssetError("the mesh has too many faces", where=path, expected=expected, found=f"{count:,}", fix=fix)
    return parts


@contextmanager
def _quiet() -> Iterator[None]:
    """Disable the log of trimesh during the block; problems are reported by errors and notes."""
    logger = logging.getLogger("trimesh")
    disabled, logger.disabled = logger.disabled, True
    try:
        yield
    finally:
        logger.disabled = disabled


class _Textures(Resolver):
    """Resolver that finds the textures of a model for trimesh, anywhere below the model's folder."""

    def __init__(self, path: Path, files: ModelFiles) -> None:
        self._path, self._files = path, files
        self._images: dict[bytes, Image.Image] = {}
        self.error: AssetError | None = None

    def add_note(self, text: str) -> None:
        """Add a note to the notes of the model."""
        self._files.notes.append(text)

    def get(self, name: str) -> bytes:
        """Return the texture with a name as the content of a BMP file, 8 bits per channel."""
        try:
            file = self._files.find(name, self._path.parent)
            if file is None:
                where, fix = self._path.parent / name, "Put the file next to the mesh."
                raise AssetError("missing texture of the mesh", where=where, fix=fix)
            image = open_texture(self._files.read(file), file, self._files.notes)
        except AssetError as error:
            self.error, image = self.error or error, Image.new("RGB", (1, 1))  # raised after trimesh has finished
        stream = io.BytesIO()
        image.save(stream, format="BMP")  # BMP needs no compression time
        return stream.getvalue()

    def keys(self) -> list[str]:
        """Return an empty list, since textures are searched only when trimesh asks for them."""
        return []

    def namespaced(self, namespace: str) -> _Textures:
        """Return this resolver, since names are relative to the model's folder in every namespace."""
        return self

    def write(self, name: str, data: Any) -> None:
        """Raise NotImplementedError; trimesh only reads with this resolver."""
        raise NotImplementedError

    def deduplicate(self, image: Image.Image) -> Image.Image:
        """Return an image as RGB; images with equal content become one object."""
        image = image.convert("RGB")
        return self._images.setdefault(image.tobytes(), image)


def _check_archive(data: bytes, path: Path, files: ModelFiles) -> None:
    """Check the unpacked size of a 3MF file; add a warning if the file has colours, which are not read."""
    try:
        archive = zipfile.ZipFile(io.BytesIO(data))
        size = sum(info.file_size for info in archive.infolist())
        if size > LARGEST_FILE:
            expected, found = f"at most {LARGEST_FILE >> 20} MB unpacked", f"{size >> 20} MB"
            raise AssetError(
                "the unpacked file is too large", where=path, expected=expected, found=found, fix="Reduce the mesh."
            )
        models = [archive.read(info) for info in archive.infolist() if info.filename.lower().endswith(".model")]
    except (zipfile.BadZipFile, zlib.error, ValueError, OSError, RuntimeError, EOFError) as error:
        raise AssetError("cannot read this mesh", where=path, found=error, fix="Export the mesh again.") from error
    if any(b"basematerials" in model or b"colorgroup" in model for model in models):
        files.notes.append(f"warning: {path.name}: ignored the colours of a 3MF file")


def _ply_checked(data: bytes, path: Path, textures: _Textures) -> tuple[bytes, int]:
    """Check the counts of elements in the header of a PLY file.

    Returns:
        The content of the file with a simplified header for trimesh, and the number of faces in the header.
    """
    end = data.find(b"end_header", 0, LONGEST_HEADER)
    if end < 0:
        raise AssetError("cannot read this mesh", where=path, expected="a PLY header", fix="Export the mesh again.")
    lines = [line.strip() for line in data[:end].splitlines()]
    names = [decode_text(match[1]).strip('"') for line in lines if (match := TEXTURE_COMMENT.match(line))]
    if len(names) > 1:
        textures.add_note(f"warning: {path.name}: ignored textures after the first, of {len(names)}")
    header = [b"ply", *[line for line in lines if line.startswith(b"format")][:1]]
    header += [f"comment TextureFile {name}".encode() for name in names[:1]]
    faces = 0
    for line in lines:
        words = line.split()
        if words[:1] == [b"element"]:
            kind, count = [*words[1:], b"", b""][:2]
            limit = MOST_FACES if kind == b"face" else MOST_VERTICES
            if not (count.isdigit() and len(count) < 12 and int(count) <= limit):
                what = f"invalid number of elements of type {decode_text(kind)[:20]!r} in the PLY header"
                found, fix = decode_text(count)[:20], "Reduce the mesh, or export it again."
                raise AssetError(what, where=path, expected=f"0 to {limit:,}", found=found, fix=fix)
            faces = int(count) if kind == b"face" else faces
            header.append(line)
        elif words[:1] == [b"property"]:
            name = words[-1]
            # with UVs but no image, trimesh would drop the colours
            name = PLY_COLORS.get(name, name) if names or name not in PLY_UVS else b"unused_" + name
            header.append(b" ".join([*words[:-1], name]))
    return b"\n".join([*header, data[end:]]), faces


def _off_faces(data: bytes, path: Path, files: ModelFiles) -> int:
    """Return the number of faces in the header of an OFF file.

    Add a warning if the file has vertex colours.
    """
    words = re.sub(rb"#[^\n]*", b"", data[:LONGEST_HEADER]).split()
    if words and words[0].upper().startswith(b"C"):
        files.notes.append(f"warning: {path.name}: ignored vertex colours of an OFF file")
    counts = words[1:3] if words and words[0].upper().endswith(b"OFF") else words[:2]
    if len(counts) < 2 or not all(count.isdigit() and len(count) < 12 for count in counts):
        raise AssetError("cannot read this mesh", where=path, expected="an OFF header", fix="Export the mesh again.")
    if int(counts[0]) > MOST_VERTICES or int(counts[1]) > MOST_FACES:
        expected, found = f"at most {MOST_FACES:,} faces and {MOST_VERTICES:,} vertices", "{1} faces, {0} vertices"
        raise AssetError(
            "the mesh has too many faces or vertices",
            where=path,
            expected=expected,
            found=found.format(*(int(count) for count in counts)),
            fix="Reduce the mesh.",
        )
    return int(counts[1])


def _parts(scene: trimesh.Scene, textures: _Textures) -> Iterator[MeshPart]:
    for node in scene.graph.nodes_geometry:
        pose, name = scene.graph[node]
        mesh = scene.geometry[name]
        if isinstance(mesh, trimesh.Trimesh):
            part = _part(mesh, textures)
            part.vertices = part.vertices @ pose[:3, :3].T + pose[:3, 3]
            if not np.array_equal(pose, np.eye(4)):
                part.normals = None
            if np.linalg.det(pose[:3, :3]) < 0:
                part.faces = part.faces[:, ::-1]
            yield part


def _part(mesh: trimesh.Trimesh, textures: _Textures) -> MeshPart:
    vertices, faces = np.array(mesh.vertices, float), np.array(mesh.faces, np.int64)
    normals = mesh._cache.cache.get("vertex_normals")  # normals of the file, not computed ones
    visual: Any = mesh.visual
    if visual.kind == "face":
        colors = np.repeat(decode_srgb(np.asarray(visual.face_colors)[:, :3]), 3, axis=0)
        return MeshPart(vertices[faces.reshape(-1)], np.arange(3 * len(faces)).reshape(-1, 3), colors=colors)
    if visual.kind == "vertex":
        return MeshPart(vertices, faces, None, decode_srgb(np.asarray(visual.vertex_colors)[:, :3]), normals)
    if visual.kind != "texture":
        return MeshPart(vertices, faces, normals=normals)
    material, uvs = visual.material, visual.uv
    image = getattr(material, "image", None)
    if isinstance(material, PBRMaterial):
        image = material.baseColorTexture
    if image is None or uvs is None or len(uvs) != len(vertices):
        colors = mesh.vertex_attributes.get("color")
        if colors is not None and len(colors) == len(vertices):
            return MeshPart(vertices, faces, None, decode_srgb(_bytes(colors)[:, :3]), normals)
        return MeshPart(vertices, faces, normals=normals, material=Material(_plain(material)))
    return MeshPart(vertices, faces, np.array(uvs, float), None, normals, Material(image=textures.deduplicate(image)))


def _plain(material: Any) -> tuple[float, float, float]:
    """Return the linear colour (3,) of a material of a COLLADA file; white for materials of other files."""
    if not isinstance(material, PBRMaterial) or material.baseColorFactor is None:
        return 1.0, 1.0, 1.0
    red, green, blue = (float(value) for value in decode_srgb(np.asarray(material.baseColorFactor)[:3]))
    glow = material.emissiveFactor
    if glow is not None and max(red, green, blue) < BLACK:
        red, green, blue = (float(value) for value in decode_srgb(255 * np.clip(glow, 0, 1)))
    return red, green, blue


def _bytes(colors: NDArray) -> NDArray:
    values = np.asarray(colors)
    return values * 255 if values.dtype.kind == "f" and len(values) and values.max() <= 1 else values
