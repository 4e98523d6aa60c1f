"""Read OBJ files with materials and textures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from asset_tools.readers.files import ModelFiles, format_missing_path
from asset_tools.readers.images import open_texture
from asset_tools.readers.obj import MtlMaterial, ObjMesh, decode_text, find_material, parse_mtl, parse_obj
from asset_tools.readers.surface import WHITE, Material, MeshPart, decode_srgb
from robocas_ms3.core.errors import AssetError

Ints = NDArray[np.int64]

IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tga", ".tif", ".tiff", ".webp")
BLACK = 0.02  # linear
COLOURED = 0.05  # minimum difference of the channels of a colour that is not grey
MOST_MATERIALS = 1000


def read_obj(path: Path, files: ModelFiles) -> list[MeshPart]:
    """Read an OBJ file as one part per material.

    Faces without a known material get the textured material of the file if there is exactly one. Otherwise these faces
    are white.

    Args:
        path: path of the file.
        files: files of the model, which reads the file, its materials and textures; notes on replaced files are added
            to ``files.notes``.

    Raises:
        AssetError: the file is damaged, or a material file or texture that its faces need is missing.
    """
    mesh = parse_obj(decode_text(files.read(path)), path)
    if len(mesh.faces) == 0:
        return []
    materials = _libraries(mesh, path, files)
    images: dict[str, Image.Image] = {}
    parts = []
    order = np.argsort(mesh.face_materials, kind="stable")
    used, starts = np.unique(mesh.face_materials[order], return_index=True)
    if len(used) > MOST_MATERIALS:
        expected = f"at most {MOST_MATERIALS}"
        fix = "Bake the materials into one texture."
        raise AssetError("the mesh has too many materials", where=path, expected=expected, found=len(used), fix=fix)
    for index, rows in zip(used.tolist(), np.split(order, starts[1:]), strict=True):
        name = mesh.material_names[index] if index >= 0 else ""
        has_uvs = bool((mesh.face_uvs[rows] >= 0).any())
        found = _material(name, materials, has_uvs, path, files)
        with_uvs = (mesh.face_uvs[rows] >= 0).all(axis=1)
        if found is not None and (found[0].image or found[0].emission_image) and not with_uvs.all() and with_uvs.any():
            parts.append(_part(mesh, rows[~with_uvs], MtlMaterial(name, found[0].color), found[1], images, files))
            rows = rows[with_uvs]  # noqa: PLW2901
        parts.append(_part(mesh, rows, *(found or (None, path)), images, files))
    return parts


def _libraries(mesh: ObjMesh, path: Path, files: ModelFiles) -> dict[str, tuple[MtlMaterial, Path]]:
    """Read all MTL files of a mesh; return name of the material -> material and path of its MTL file."""
    places: list[Path] = []
    missing: list[str] = []
    for line in mesh.libraries:
        whole = files.find(line, path.parent)
        for name in [line] if whole is not None else line.split():
            file = files.find(name, path.parent)
            if file is not None:
                places.append(file)
            else:
                missing.append(name if len(line.split()) == 1 else line)
    if not places and (missing or mesh.material_names or (not mesh.libraries and len(mesh.uvs))):
        sibling = _find_sibling(path, (".mtl",)) or _only_library(mesh, path, files)
        if sibling is not None:
            places.append(sibling)
            files.notes.append(f"used {sibling.name} instead of {missing[0] if missing else 'the material file'}")
        elif missing and (len(mesh.uvs) or mesh.material_names):
            what, fix = "missing material file of the mesh", "Put the file next to the mesh."
            raise AssetError(what, where=path.parent / missing[0], fix=fix)
    found: dict[str, tuple[MtlMaterial, Path]] = {}
    for place in dict.fromkeys(places):
        materials = parse_mtl(decode_text(files.read(place)))
        found |= {name: (material, place) for name, material in materials.items() if name not in found}
    return found


def _find_sibling(path: Path, suffixes: tuple[str, ...]) -> Path | None:
    """Return the file next to ``path`` with an equal stem and one of the suffixes, or None."""
    alike = {file.suffix.lower(): file for file in path.parent.iterdir() if file.stem.lower() == path.stem.lower()}
    return next((alike[suffix] for suffix in suffixes if suffix in alike), None)


def _only_library(mesh: ObjMesh, path: Path, files: ModelFiles) -> Path | None:
    """Return the only MTL file next to an OBJ file if it has all materials of the faces, or None."""
    found = [file for file in path.parent.iterdir() if file.suffix.lower() == ".mtl"]
    if len(found) != 1 or not mesh.material_names:
        return None
    materials = parse_mtl(decode_text(files.read(found[0])))
    return found[0] if all(find_material(name, materials) for name in mesh.material_names) else None


def _material(
    name: str, materials: dict[str, tuple[MtlMaterial, Path]], has_uvs: bool, path: Path, files: ModelFiles
) -> tuple[MtlMaterial, Path] | None:
    """Choose the material of faces; return the material and the path of its file, or None for white faces.

    Args:
        name: name of the material in the OBJ file; empty: none.
        materials: name -> material and path of its MTL file.
        has_uvs: whether a face has texture coordinates.
        path: path of the OBJ file.
        files: files of the model; a note is added if another material or an image is used.
    """
    exact = find_material(name, {key: material for key, (material, _) in materials.items()}) if name else None
    if exact is not None:
        return materials[exact.name]
    textured = [entry for entry in materials.values() if entry[0].image]
    only = textured[0] if len(textured) == 1 else None
    if only is None and len(materials) == 1:
        only = next(iter(materials.values()))
    if only is not None and (has_uvs or not only[0].image):
        files.notes.append(
            f"used the material {only[0].name} for faces {f'of {name}' if name else 'without a material'}"
        )
        return only
    image = _find_sibling(path, IMAGES)
    if has_uvs and image is not None and not materials:
        files.notes.append(f"used {image.name} for faces {f'of {name}' if name else 'without a material'}")
        return MtlMaterial(name, image=image.name), path
    if materials or (name and has_uvs):
        known = ", ".join(list(materials)[:5]) or "none"
        what = f"faces of the material {name}" if name else "faces without a material"
        files.notes.append(f"warning: {path.name}: {what} are white; known materials: {known}")
    return None


def _part(
    mesh: ObjMesh,
    rows: Ints,
    material: MtlMaterial | None,
    place: Path,
    images: dict[str, Image.Image],
    files: ModelFiles,
) -> MeshPart:
    """Return the part with the given faces; each distinct corner of a face becomes a vertex.

    Args:
        mesh: content of the OBJ file.
        rows: (F,) indices of the faces.
        material: material of the faces; None: white.
        place: path of the material's MTL file.
        images: name -> texture image; images that are read are added.
        files: files of the model.
    """
    use_normals = bool((mesh.face_normals[rows] >= 0).all())
    shown, uv_map = _resolve_material(material, place, images, files, bool((mesh.face_uvs[rows] >= 0).all()))
    columns = [mesh.faces[rows].reshape(-1)]
    columns.append(mesh.face_uvs[rows].reshape(-1) if shown.image is not None else np.full(3 * len(rows), -1))
    columns.append(mesh.face_normals[rows].reshape(-1) if use_normals else np.full(3 * len(rows), -1))
    corners, inverse = np.unique(np.column_stack(columns), axis=0, return_inverse=True)
    uvs = None
    if shown.image is not None:
        scale, offset = uv_map
        uvs = mesh.uvs[corners[:, 1]] * scale + offset
    colors = None
    if mesh.colors is not None:
        values = mesh.colors[corners[:, 0]]
        if shown.image is None:
            colors, shown = decode_srgb(255 * values), Material()  # Kd in addition to vertex colours is a default value
        elif (values != 1).any():
            files.notes.append("warning: ignored vertex colours in addition to a texture")
    normals = mesh.normals[corners[:, 2]] if use_normals else None
    if normals is not None:
        normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return MeshPart(mesh.vertices[corners[:, 0]], inverse.reshape(-1, 3), uvs, colors, normals, shown)


def _resolve_material(
    material: MtlMaterial | None, place: Path, images: dict[str, Image.Image], files: ModelFiles, has_uvs: bool
) -> tuple[Material, tuple[tuple[float, float], tuple[float, float]]]:
    """Convert a material of an MTL file to a colour and an image; also return scale and offset of the UVs."""
    plain = (1.0, 1.0), (0.0, 0.0)
    if material is None:
        return Material(), plain
    if material.transparent:
        files.notes.append("warning: ignored transparency")
    name = material.image
    if material.emission_image and (not name or (material.color is not None and max(material.color) < BLACK)):
        name = material.emission_image
    if name and has_uvs:
        if name not in images:
            file = files.find(name, place.parent)
            if file is None:
                where = format_missing_path(name, place.parent)
                what, fix = "missing texture file of the material", "Put the file next to the mesh."
                raise AssetError(what, where=where, fix=fix)
            images[name] = open_texture(files.read(file), file, files.notes)
        # a grey Kd in addition to a texture is a default value: scanners write 0.8 or 0
        tinted = material.color is not None and np.ptp(material.color) > COLOURED and name == material.image
        color = _linear(material.color) if tinted and material.color is not None else WHITE
        return Material(color, images[name]), (material.uv_scale, material.uv_offset)
    if name:
        files.notes.append(f"warning: ignored the texture {name}: faces without texture coordinates")
    color = material.color
    if color is not None and material.emission is not None and max(color) < BLACK:
        color = material.emission
    if color is None:
        return Material(), plain
    return Material(_linear(color)), plain


def _linear(color: tuple[float, float, float]) -> tuple[float, float, float]:
    red, green, blue = (float(value) for value in decode_srgb(255 * np.array(color)))
    return red, green, blue
