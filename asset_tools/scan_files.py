"""The files that a mesh file names, materials and textures: found wherever they lie, or an error that names them."""

from __future__ import annotations

import re
import struct
import unicodedata
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from PIL import Image
from trimesh.resolvers import Resolver

from robocas_ms3.documents import json_values
from robocas_ms3.errors import AssetError

LARGEST = 16384**2  # pixels of a texture: 0.8 GB once unpacked
USEFUL = 4096  # pixels of its longer side: what more there is, is shrunk before anything is done with it
NEEDED = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_texture_basisu")  # of glTF; not read here


@dataclass
class ScanFiles(Resolver):
    """What a mesh file names, by the names it is asked for.

    Attributes:
        data: contents; materials are rewritten so that a loader finds what they name.
        paths: where the textures lie.
        materials: names of the materials of an OBJ.
        textured: the file says that it has a texture.
    """

    data: dict[str, bytes] = field(default_factory=dict)
    paths: dict[str, Path] = field(default_factory=dict)
    materials: set[str] = field(default_factory=set)
    textured: bool = False

    def get(self, name: str) -> bytes:
        """Contents of a file."""
        return self.data[name]

    def keys(self) -> Any:
        """Names of the files."""
        return self.data.keys()

    def namespaced(self, namespace: str) -> ScanFiles:
        """Itself: names are those that stand in the mesh file."""
        return self

    def write(self, name: str, data: Any) -> None:
        """Refuse to write: a scan is only read."""
        raise NotImplementedError


def scan_files(path: Path, repairs: list[str]) -> ScanFiles:
    """Find what a mesh file names.

    Args:
        path: of the mesh.
        repairs: gets a line for each file that isn't where the mesh says.

    Raises:
        AssetError: a file is missing, or no image.
    """
    files = ScanFiles()
    suffix = path.suffix.lower()
    if suffix == ".obj":
        _of_obj(path, files, repairs)
    elif suffix in (".gltf", ".glb"):
        _of_gltf(path, files, repairs)
    elif suffix == ".ply":
        with path.open("rb") as file:
            head = file.read(65536).partition(b"end_header")[0]
        for name in re.findall(r"^comment TextureFile (.*?)\r?$", decode(head), flags=re.MULTILINE):
            _add_texture(name, name.strip(), path, files, repairs)
    return files


def decode(data: bytes) -> str:
    """Text of a file: UTF-8, with or without a mark, or else Latin letters as Windows has them."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("cp1252", errors="replace")


@contextmanager
def large_images() -> Iterator[None]:
    """Let Pillow open images as large as textures may be; by itself it refuses them, fearing for the memory."""
    limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, LARGEST
    try:
        yield
    finally:
        Image.MAX_IMAGE_PIXELS = limit


def sound_image(image: Image.Image, where: Path, repairs: list[str]) -> Image.Image:
    """A texture, read and of a useful size.

    Raises:
        AssetError: it is cut short.
    """
    width, height = image.size
    try:
        if max(width, height) <= USEFUL:
            image.load()
            return image
        image.draft(image.mode, (USEFUL, USEFUL))  # JPEG can be read at a part of its size
        image = image if image.mode in ("L", "RGB", "RGBA") else image.convert("RGB")  # palettes don't mix
        scale = -(-max(image.size) // USEFUL)
        small = image.reduce(scale) if scale > 1 else image.copy()
    except (OSError, SyntaxError) as error:
        raise AssetError("can't read the texture", where=where, found=error) from error
    repairs.append(f"shrank the texture from {width} x {height} to {small.width} x {small.height}")
    return small


def _of_obj(path: Path, files: ScanFiles, repairs: list[str]) -> None:
    material_file = ""
    for name in re.findall(r"^[ \t]*mtllib[ \t]+(.*?)[ \t]*\r?$", decode(path.read_bytes()), flags=re.MULTILINE):
        file = _find(path.parent, name, repairs)
        if file is None:
            raise AssetError("the material file that the mesh names is missing", where=path.parent / name)
        for material in re.split(r"^\s*newmtl\s", decode(file.read_bytes()), flags=re.MULTILINE)[1:]:
            material_file += _material(material, file, files, repairs)
        files.data[name] = b""
    for name in files.data.keys() - files.paths.keys():
        files.data[name] = material_file.encode()


def _material(text: str, file: Path, files: ScanFiles, repairs: list[str]) -> str:
    """A material with its colour map under a name of ours."""
    name, *lines = text.splitlines()
    files.materials.add(" ".join(name.split()))
    kept, maps = [f"newmtl {name.strip()}"], {}
    for line in lines:
        key, _, value = line.strip().partition(" ")
        if not key.lower().startswith(("map_", "bump", "disp", "norm", "refl", "decal")):
            kept.append(line)
        elif value.strip():
            # options (-s 1 1 1, -clamp on) may stand before the name, and the name may hold spaces
            maps[key.lower()] = re.sub(r"^\s*(-\w+(\s+(on|off|-?[\d.]+))*\s+)+", "", value).strip()
    texture = maps.get("map_kd") or maps.get("map_ka")
    if texture:
        key = f"texture_{len(files.paths)}"
        _add_texture(key, texture, file, files, repairs)
        kept.append(f"map_Kd {key}")
    return "\n".join(kept) + "\n"


def _of_gltf(path: Path, files: ScanFiles, repairs: list[str]) -> None:
    data = path.read_bytes()
    if path.suffix.lower() == ".glb":
        data = data[20 : 20 + struct.unpack("<I", data[12:16])[0]] if len(data) > 20 else b""
    try:
        tree = json_values(data)
    except ValueError as error:
        raise AssetError("can't read this mesh", where=path, found=f"no JSON: {error}") from error
    if not isinstance(tree, dict):
        raise AssetError("can't read this mesh", where=path, expected="an object of JSON", found=str(tree)[:40])
    needed = [name for name in tree.get("extensionsRequired", []) if name in NEEDED]
    if needed:
        fix = "Export it without compression."
        raise AssetError("the file is compressed in a way that can't be read", where=path, found=needed[0], fix=fix)
    shadings = (material.get("pbrMetallicRoughness", {}) for material in tree.get("materials", []))
    files.textured = any("baseColorTexture" in shading for shading in shadings)
    for kind in ("images", "buffers"):
        for entry in tree.get(kind, []):
            uri = entry.get("uri", "data:")
            if uri.startswith("data:"):
                continue
            if kind == "images":
                _add_texture(uri, unquote(uri), path, files, repairs, what="a file this mesh names is missing")
                continue
            file = _find(path.parent, unquote(uri), repairs)
            if file is None:
                raise AssetError("a file this mesh names is missing", where=path.parent / unquote(uri))
            files.data[uri] = file.read_bytes()


def _add_texture(
    key: str,
    name: str,
    file: Path,
    files: ScanFiles,
    repairs: list[str],
    what: str = "the texture file that the material names is missing",
) -> None:
    image = _find(file.parent, name, repairs)
    if image is None:
        raise AssetError(what, where=file.parent / name.replace("\\", "/"), found=file.name)
    try:
        with large_images(), Image.open(image) as opened:
            width, height = opened.size
    except Image.DecompressionBombError:
        width = height = 2 * LARGEST
    except (OSError, SyntaxError) as error:
        raise AssetError("can't read the texture", where=image, found=error) from error
    if width * height > LARGEST:
        raise AssetError("the texture is too large", where=image, expected="at most 16384 x 16384 pixels")
    files.data[key], files.paths[key] = image.read_bytes(), image
    files.textured = True


def _find(folder: Path, name: str, repairs: list[str]) -> Path | None:
    """A file by the name that a mesh gives it, which may be of another machine, or written in another way."""
    name = name.strip().strip('"')
    plain = name.replace("\\", "/")
    relative = not plain.startswith("/") and ":" not in plain
    if relative and (folder / plain).is_file():
        if plain != name:
            repairs.append(f"read {name} as {plain}")
        return folder / plain
    wanted = _letters(plain.rsplit("/", 1)[-1])
    alike = [path for path in folder.rglob("*") if path.is_file() and _letters(path.name) == wanted]
    if not alike:
        return None
    found = min(alike, key=lambda path: (len(path.parts), path.as_posix()))
    repairs.append(f"took {found.relative_to(folder).as_posix()} for {name}")
    return found


def _letters(name: str) -> str:
    """A name whatever its letters' case, and however its accents are written."""
    return unicodedata.normalize("NFC", name).casefold()
