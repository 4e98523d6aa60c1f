"""A model's files as one mesh."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import trimesh

from asset_tools.reading.choice import FORMATS, Candidate, choose, is_mesh, mesh_files
from asset_tools.reading.exchange import read_exchange
from asset_tools.reading.files import ModelFiles
from asset_tools.reading.gltf import read_gltf
from asset_tools.reading.obj import MOST_FACES
from asset_tools.reading.obj_model import read_obj
from asset_tools.reading.surface import Part, to_mesh
from robocas_ms3.errors import AssetError, RobocasError

READERS: dict[str, Callable[[Path, ModelFiles], list[Part]]] = {
    ".obj": read_obj,
    ".glb": read_gltf,
    ".gltf": read_gltf,
}  # the others are trimesh's


UPS: dict[bytes, Literal["x", "y", "z"]] = {b"X": "x", b"Y": "y", b"Z": "z"}


@dataclass(frozen=True, eq=False)
class Model:
    """What was read of a model.

    Attributes:
        mesh: of all its triangles, in the unit and frame of the file.
        up: axis that points up by the format's rules; None: the format has none.
        files: all that were read, for a content hash.
        notes: files used and ignored, substitutions, and warnings; a line each.
    """

    mesh: trimesh.Trimesh
    up: Literal["x", "y", "z"] | None
    files: tuple[Path, ...]
    notes: tuple[str, ...]


def read_model(path: Path | list[Path], root: Path | None = None) -> Model:
    """Read a model: a mesh file, a folder with its files, or several files of which some may be versions.

    Args:
        path: of the model.
        root: the imported folder, outside of which nothing is read; None: the model's own folder.

    Raises:
        AssetError: a file is missing, damaged, too large or outside of ``root``; the mesh is empty, of no size or not
            finite; or a folder holds several objects.
    """
    paths = [Path(os.path.abspath(one)) for one in (path if isinstance(path, list) else [path])]
    whole, home = paths[0], paths[0] if paths[0].is_dir() else paths[0].parent
    files = ModelFiles(Path(os.path.abspath(root or home)), home)
    if len(paths) == 1 and not whole.is_dir():
        chosen = [_candidate(whole, files)]
    else:
        shown, collision = mesh_files(whole) if whole.is_dir() else (paths, [])
        chosen = _chosen(shown, collision, home, files)
    mesh = to_mesh([part for candidate in chosen for part in candidate.parts])
    _check(mesh, whole)
    return Model(mesh, _up(chosen[0].path, files), tuple(files.used), tuple(dict.fromkeys(files.notes)))


def _chosen(shown: list[Path], collision: list[Path], home: Path, files: ModelFiles) -> list[Candidate]:
    """Return the candidates that are the object; only what they need counts as read."""
    candidates: list[tuple[Candidate, ModelFiles]] = []
    errors: dict[Path, RobocasError] = {}
    for path in shown:
        own = ModelFiles(files.root, files.home)
        try:
            candidate = _candidate(path, own)
        except RobocasError as error:
            errors[path] = error
        else:
            candidates.append((candidate, own))
    if not candidates:
        raise next(iter(errors.values()))
    chosen = choose([candidate for candidate, _ in candidates], home, files.notes)
    names = {path: path.relative_to(home).as_posix() for path in (*shown, *collision)}
    if not files.notes and len(names) > 1:
        files.notes.append(f"used {names[chosen[0].path]}")
    files.notes.extend(f"ignored {names[path]}: a collision mesh" for path in collision)
    files.notes.extend(f"warning: ignored {names[path]}: {error}" for path, error in errors.items())
    for candidate, own in candidates:
        if candidate in chosen:
            files.notes.extend(own.notes)
            files.used.extend(path for path in own.used if path not in files.used)
    return chosen


def _candidate(path: Path, files: ModelFiles) -> Candidate:
    if not os.path.lexists(path):
        raise AssetError("there is no such mesh", where=path)
    if not is_mesh(path):
        raise AssetError("not a mesh file", where=path, expected=f"one of {', '.join(FORMATS)}", found=path.suffix)
    parts = READERS.get(path.suffix.lower(), read_exchange)(path, files)
    parts = [part for part in parts if len(part.faces)]
    if not parts:
        raise AssetError("the mesh is empty", where=path, expected="triangles", found="none")
    return Candidate(path, parts)


def _check(mesh: trimesh.Trimesh, path: Path) -> None:
    if len(mesh.faces) > MOST_FACES:
        expected = f"at most {MOST_FACES:,}"
        raise AssetError("the mesh has too many faces", where=path, expected=expected, fix="Reduce it.")
    finite = np.isfinite(mesh.vertices).all(axis=1)
    if not finite.all():
        found = f"{int((~finite).sum())} of {len(finite)}"
        raise AssetError("the mesh has vertices that are not finite", where=path, found=found)
    size = np.ptp(mesh.vertices[np.unique(mesh.faces)], axis=0).max()
    if not 1e-9 < size < 1e9:
        raise AssetError("the mesh has no usable size", where=path, expected="1e-9 to 1e9 units", found=f"{size:g}")


def _up(path: Path, files: ModelFiles) -> Literal["x", "y", "z"] | None:
    suffix = path.suffix.lower()
    if suffix in (".glb", ".gltf"):
        return "y"
    if suffix == ".dae":
        found = re.search(rb"<up_axis>\s*([XYZ])_UP", files.read(path))
        return UPS[found[1]] if found else "y"  # which is the format's default
    return None
