"""Read the files of a model as one mesh, in all supported formats."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import trimesh

from asset_tools.readers.choice import (
    FORMATS,
    Candidate,
    choose_candidates,
    find_mesh_files,
    is_collision_mesh,
    is_mesh_file,
)
from asset_tools.readers.exchange import read_exchange
from asset_tools.readers.files import ModelFiles
from asset_tools.readers.gltf import read_gltf
from asset_tools.readers.obj import MOST_FACES
from asset_tools.readers.obj_model import read_obj
from asset_tools.readers.surface import MeshPart, join_parts
from robocas_ms3.core.errors import AssetError, RobocasError

READERS: dict[str, Callable[[Path, ModelFiles], list[MeshPart]]] = {
    ".obj": read_obj,
    ".glb": read_gltf,
    ".gltf": read_gltf,
}  # trimesh reads other formats


LARGEST_UV = 1e4  # more repetitions of an image are an error of the file
UPS: dict[bytes, Literal["x", "y", "z"]] = {b"X": "x", b"Y": "y", b"Z": "z"}


@dataclass(frozen=True, eq=False)
class Model:
    """A model that was read from files.

    Attributes:
        mesh: all triangles, in the unit and frame of the file.
        up: axis that points up according to the file format; None: the format does not define it.
        files: all files that were read, for the hash of the inputs.
        notes: one line for each used, ignored or replaced file, and for each warning.
    """

    mesh: trimesh.Trimesh
    up: Literal["x", "y", "z"] | None
    files: tuple[Path, ...]
    notes: tuple[str, ...]


def read_model(path: Path | list[Path], root: Path | None = None) -> Model:
    """Read a model as one mesh.

    Args:
        path: a mesh file, a folder of mesh files, or several mesh files, which may be versions of one mesh.
        root: the imported folder; files outside of this folder are not read. None: the folder of the model.

    Raises:
        AssetError: a file is missing, damaged, too large or outside of ``root``; the mesh is empty or has an invalid
            size; or the folder contains several objects.
    """
    paths = [Path(os.path.abspath(item)) for item in (path if isinstance(path, list) else [path])]
    is_folder = paths[0].is_dir()
    home = paths[0] if is_folder else paths[0].parent
    files = ModelFiles(Path(os.path.abspath(root or home)), home, None if is_folder else paths[0].stem)
    if len(paths) == 1 and not is_folder:
        chosen = [_candidate(paths[0], files)]
    else:
        chosen = _chosen(find_mesh_files(home) if is_folder else paths, files)
    mesh = join_parts([part for candidate in chosen for part in candidate.parts])
    _check(mesh, paths[0])
    return Model(mesh, _up(chosen[0].path, files), tuple(files.used), tuple(dict.fromkeys(files.notes)))


def _chosen(paths: list[Path], files: ModelFiles) -> list[Candidate]:
    """Read mesh files and return the candidates that form the object.

    Args:
        paths: mesh files.
        files: files of the model; notes on the used files are added to ``files.notes``.

    Raises:
        AssetError: no file can be read, or the files are not parts of one object.
    """
    collision = [path for path in paths if is_collision_mesh(path, files.home)]
    if len(collision) == len(paths):
        collision = []
    shown = [path for path in paths if path not in collision]
    candidates: list[tuple[Candidate, ModelFiles]] = []
    errors: dict[Path, RobocasError] = {}
    for path in shown:
        own = ModelFiles(files.root, files.home, files.stem)
        try:
            candidates.append((_candidate(path, own), own))
        except RobocasError as error:
            errors[path] = error
    if not candidates:
        raise next(iter(errors.values()))
    chosen = choose_candidates([candidate for candidate, _ in candidates], files.home, files.notes)
    names = {path: path.relative_to(files.home).as_posix() for path in paths}
    if not files.notes and len(paths) > 1:
        files.notes.append(f"used {names[chosen[0].path]}")
    files.notes.extend(f"ignored {names[path]}: a collision mesh" for path in collision)
    files.notes.extend(f"warning: ignored {names[path]}: {error}" for path, error in errors.items())
    for candidate, own in candidates:
        # files that were not chosen also count, since they affect the notes
        files.used.extend(path for path in own.used if path not in files.used)
        if candidate in chosen:
            files.notes.extend(own.notes)
    return chosen


def _candidate(path: Path, files: ModelFiles) -> Candidate:
    if not os.path.lexists(path):
        raise AssetError("no such mesh file", where=path, fix="Check the path.")
    if not is_mesh_file(path):
        expected, found = f"a file of type {', '.join(FORMATS)}", path.suffix or "a file without suffix"
        raise AssetError("not a mesh file", where=path, expected=expected, found=found)
    parts = READERS.get(path.suffix.lower(), read_exchange)(path, files)
    parts = [_clean(part, path, files) for part in parts if len(part.faces)]
    if not parts:
        fix = "Export the mesh again, with its faces."
        raise AssetError("the mesh is empty", where=path, expected="triangles", found="no triangles", fix=fix)
    return Candidate(path, parts)


def _clean(part: MeshPart, path: Path, files: ModelFiles) -> MeshPart:
    """Return a part without unused vertices, and without UVs, colours or normals that are NaN or infinite.

    Raises:
        AssetError: a face has a NaN or infinite vertex.
    """
    used, faces = np.unique(part.faces, return_inverse=True)
    vertices, uvs, colors, normals = (
        None if values is None else values[used] for values in (part.vertices, part.uvs, part.colors, part.normals)
    )
    assert vertices is not None
    if not np.isfinite(vertices).all():
        found = f"{int((~np.isfinite(vertices).all(axis=1)).sum())} of {len(vertices)} vertices"
        fix = "Export the mesh again."
        raise AssetError("the mesh has NaN or infinite vertices", where=path, found=found, fix=fix)
    if uvs is not None and not (np.abs(uvs) < LARGEST_UV).all():
        files.notes.append(f"warning: {path.name}: ignored a texture with NaN or infinite coordinates")
        uvs = None
    if colors is not None and not np.isfinite(colors).all():
        files.notes.append(f"warning: {path.name}: ignored NaN or infinite vertex colours")
        colors = None
    if normals is not None and not (np.isfinite(normals).all() and (np.abs(normals) <= 1.01).all()):
        normals = None
    return MeshPart(vertices, faces.reshape(-1, 3), uvs, colors, normals, part.material)


def _check(mesh: trimesh.Trimesh, path: Path) -> None:
    if len(mesh.faces) > MOST_FACES:
        expected, found, fix = f"at most {MOST_FACES:,}", f"{len(mesh.faces):,}", "Reduce the number of faces."
        raise AssetError("the mesh has too many faces", where=path, expected=expected, found=found, fix=fix)
    size, fix = float(mesh.extents.max()), "Export the mesh again, in metres."
    if not 1e-9 < size < 1e9:
        expected, found = "a longest side of 1e-9 to 1e9 units", f"{size:g}"
        raise AssetError("invalid size of the mesh", where=path, expected=expected, found=found, fix=fix)


def _up(path: Path, files: ModelFiles) -> Literal["x", "y", "z"] | None:
    suffix = path.suffix.lower()
    if suffix in (".glb", ".gltf"):
        return "y"
    if suffix == ".dae":
        found = re.search(rb"<up_axis>\s*([XYZ])_UP", files.read(path))
        return UPS[found[1]] if found else "y"  # default of the format
    return None
