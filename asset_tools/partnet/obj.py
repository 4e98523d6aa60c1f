"""Read PartNet-Mobility's OBJ files with materials; faces are not merged and may be double-sided."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from asset_tools.readers.files import ModelFiles, check_inside
from asset_tools.readers.obj import MtlMaterial, ObjMesh, decode_text, find_material, parse_mtl, parse_obj
from robocas_ms3.core.errors import AssetError

Array = np.ndarray

GREY = (0.7, 0.7, 0.7)
MOST_REPEATS = 1000  # repetitions of a texture on faces of one material, each of which is written out
FARTHEST_UV = 1e6
OBJ_LIMIT = 64 * 2**20  # bytes; the largest of PartNet-Mobility have some 10 MB


@dataclass(frozen=True)
class Material:
    """Material of faces: a texture, or one colour.

    Attributes:
        color: sRGB colour in 0..1, used if there is no texture.
        image: path of the texture without links, or None.
    """

    color: tuple[float, float, float] = GREY
    image: Path | None = None


@dataclass(frozen=True)
class Faces:
    """Triangles of one material.

    Attributes:
        corners: (F, 3, 3) corners of the triangles, m.
        uv: (F, 3, 2) texture coordinates, v upward; zeros if the file has none.
        material: material of the faces.
    """

    corners: Array
    uv: Array
    material: Material


def read_obj(path: Path, files: ModelFiles, color: tuple[float, float, float] | None) -> list[Faces]:
    """Read an OBJ file as one group of faces per material; return [] if all faces are degenerate.

    Args:
        path: path of the file.
        files: files of the model; notes on missing files are added to ``files.notes``.
        color: sRGB colour in 0..1 of faces without a known material; None: grey.

    Raises:
        AssetError: a file cannot be read, or is outside of the model's folder.
    """
    data = files.read(path)
    if len(data) > OBJ_LIMIT:
        expected, found = f"at most {OBJ_LIMIT >> 20} MB", f"{len(data) >> 20} MB"
        raise AssetError(
            "the mesh file is too large", where=path, expected=expected, found=found, fix="Reduce the mesh."
        )
    mesh = parse_obj(decode_text(data), path)
    corners = mesh.vertices[mesh.faces]
    if not np.isfinite(corners).all():
        raise AssetError("the mesh has NaN or infinite vertices", where=path, fix="Export the mesh again.")
    if not has_area(corners):
        return []
    uvs = np.concatenate([mesh.uvs, np.zeros((1, 2))])[mesh.face_uvs]  # index -1: zeros
    found = _materials(mesh, path, files)
    groups = []
    for index in np.unique(mesh.face_materials, return_index=True)[0].tolist():
        own = mesh.face_materials == index
        look, folder = found.get(index, (None, path.parent))
        material = Material(color or GREY) if look is None else _material(look, folder, files)
        uv = uvs[own] if look is None else uvs[own] * look.uv_scale + look.uv_offset
        if not (np.abs(uv) <= FARTHEST_UV).all() or np.ptp(uv) > MOST_REPEATS:  # false for NaN
            files.notes.append(f"{path.name}: invalid texture coordinates; the faces have a plain colour")
            uv, material = np.zeros_like(uv), Material(material.color)
        groups.append(Faces(corners[own], uv, material))
    return groups


def has_area(corners: Array) -> bool:
    """Return whether at least one of the triangles (F, 3, 3) has an area above 0."""
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return len(areas) > 0 and bool(areas.max() > 0)


def _materials(mesh: ObjMesh, path: Path, files: ModelFiles) -> dict[int, tuple[MtlMaterial, Path]]:
    """Return index of the material in the mesh -> material and folder in which its images are searched."""
    known: dict[str, MtlMaterial] = {}
    homes: dict[str, Path] = {}
    for file in _libraries(mesh, path, files):
        new = parse_mtl(decode_text(files.read(file)))
        known |= new
        homes |= dict.fromkeys(new, file.parent)
    only = next(iter(known.values())) if len(known) == 1 else None
    found = {}
    for index in np.unique(mesh.face_materials).tolist():
        name = mesh.material_names[index] if index >= 0 else ""
        look = find_material(name, known) or only
        if look is not None:
            found[index] = look, homes[look.name]
        elif known or name:
            files.notes.append(f"{path.name}: no material {name!r}; the faces have a plain colour")
    return found


def _libraries(mesh: ObjMesh, path: Path, files: ModelFiles) -> list[Path]:
    """Return the paths of the MTL files of a mesh; ``<mesh>.mtl`` replaces a missing file."""
    found = []
    for line in mesh.libraries:
        whole = files.find(line, path.parent)
        for name in [line] if whole else line.split():
            library = whole or files.find(name, path.parent)
            own = path.with_suffix(".mtl")
            if library is None and own.is_file():
                files.notes.append(f"{path.name}: used {own.name} instead of the missing {name}")
                library = own
            if library is None:
                files.notes.append(f"{path.name}: the material file {name} is missing")
            else:
                found.append(library)
    return list(dict.fromkeys(found))


def _material(look: MtlMaterial, folder: Path, files: ModelFiles) -> Material:
    image = files.find(look.image, folder) if look.image else None
    if image is None:
        if look.image:
            files.notes.append(f"the texture {look.image} is missing: its faces have a plain colour")
        return Material(look.color or GREY)
    check_inside(image, files.root)
    return Material(look.color or GREY, image.resolve())
