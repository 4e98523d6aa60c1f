"""Reading raw scans: which file, is it whole, in which unit, which way up."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, get_args
from urllib.parse import unquote

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image
from shapely import MultiPoint

from robocas_ms3.errors import AssetError

Array = NDArray[np.float64]
Unit = Literal["m", "cm", "mm", "inch"]
Up = Literal["x", "y", "z", "-x", "-y", "-z"]

METRES: dict[str, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254}
UPS: tuple[str, ...] = get_args(Up)
FORMATS = (".obj", ".glb", ".gltf", ".ply", ".stl", ".off", ".dae", ".3mf")  # the better first
PLAUSIBLE = (0.005, 1.5)  # m, longest side of a thing that a hand can pick up, generously
TYPICAL = 0.15  # m, longest side of a household object
STANDS = 0.27  # thickness over height down to which people put a box on its end
BOX_FILL = 0.93  # share of its rectangle that a box's outline fills; an ellipse fills 0.785
COLOUR_MAPS = ("map_kd", "map_ka")  # others are not used


def find_mesh(path: Path) -> Path:
    """The mesh file of a scan: the file itself, or the best one in a folder (textured ones and OBJ first).

    Raises:
        AssetError: there is none.
    """
    if path.is_file():
        if path.suffix.lower() in FORMATS:
            return path
        raise AssetError("not a mesh file", where=path, expected=f"one of {', '.join(FORMATS)}", found=path.suffix)
    if not path.is_dir():
        raise AssetError("there is no such mesh", where=path)
    found = [file for file in path.iterdir() if file.suffix.lower() in FORMATS and not file.name.startswith(".")]
    if not found:
        raise AssetError("no mesh in this folder", where=path, expected=f"a file that ends in {', '.join(FORMATS)}")
    return min(found, key=lambda file: (_plain(file), FORMATS.index(file.suffix.lower()), file.name))


def load_scan(path: Path) -> trimesh.Trimesh:
    """Load a scan with its colours, as it is: unit and axes are the file's.

    Raises:
        AssetError: the file is missing, damaged, empty, of no size or not finite, or a texture it names is missing.
    """
    path = find_mesh(path)
    textures = _textures(path)
    try:
        loaded = trimesh.load_scene(path, process=False)
        mesh = loaded.to_mesh() if loaded.geometry else trimesh.Trimesh()
    except Exception as error:  # the loaders raise whatever their parsing runs into
        raise AssetError("can't read this mesh", where=path, found=f"{type(error).__name__}: {error}") from error
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0 or len(mesh.vertices) == 0:
        raise AssetError("the mesh is empty", where=path, expected="triangles", found="none")
    if not np.isfinite(mesh.vertices).all():
        bad = int((~np.isfinite(mesh.vertices)).any(axis=1).sum())
        raise AssetError(
            "the mesh has vertices that are not finite", where=path, found=f"{bad} of {len(mesh.vertices)}"
        )
    if np.ptp(mesh.vertices[mesh.faces].reshape(-1, 3), axis=0).max() <= 0:
        raise AssetError("the mesh has no size", where=path, found="all vertices in one point")
    material = getattr(mesh.visual, "material", None)
    if len(textures) == 1 and material is not None and getattr(material, "image", textures) is None:
        material.image = textures[0]  # the loader stumbles over options and spaces in names
    return mesh


def guess_unit(longest: Sequence[float]) -> Unit:
    """The unit in which a set of scans was made: metres, centimetres or millimetres.

    Inches are too near to centimetres to be told from sizes.

    Args:
        longest: longest side of each scan, in its unit.

    Raises:
        AssetError: in none of them are the things of a size that can be picked up.
    """
    middle = float(np.median(longest))
    best = min(("m", "cm", "mm"), key=lambda unit: abs(np.log(middle * METRES[unit] / TYPICAL)))
    if not PLAUSIBLE[0] <= middle * METRES[best] <= PLAUSIBLE[1]:
        raise AssetError(
            "can't guess the unit of the scans",
            expected=f"{PLAUSIBLE[0]} to {PLAUSIBLE[1]} m for the longest side",
            found=f"{middle:g} units",
            fix="Pass --units.",
        )
    return best  # pyright: ignore[reportReturnType]


def guess_up(mesh: trimesh.Trimesh, suffix: str = "") -> Up:
    """The axis that points up: y or z, the two that software uses.

    glTF has y up by definition. Else a thing with a long axis stands on it, unless it is a flat box; a flat thing
    lies on its broad side.

    Args:
        mesh: any unit.
        suffix: of its file.
    """
    if suffix.lower() in (".glb", ".gltf"):
        return "y"
    hull = mesh.convex_hull
    x, y, z = np.ptp(hull.vertices, axis=0)
    size = {"x": x, "y": y, "z": z}
    long = max(size, key=lambda axis: size[axis])
    if long != "x":
        across = sorted(size[axis] for axis in size if axis != long)
        boxy = _fill(hull, "xyz".index(long)) > BOX_FILL
        if not boxy or across[0] / size[long] >= STANDS:
            return long  # pyright: ignore[reportReturnType]
    return "y" if y < z else "z"


def upright(mesh: trimesh.Trimesh, up: Up) -> trimesh.Trimesh:
    """A copy with an axis of the file turned to +z."""
    turned = mesh.copy()
    axis = np.zeros(3)
    axis["xyz".index(up[-1])] = -1.0 if up.startswith("-") else 1.0
    transform = np.diag([1.0, -1.0, -1.0, 1.0]) if up == "-z" else np.eye(4)
    if axis[2] == 0:
        quarter = trimesh.transformations.rotation_matrix(np.pi / 2, np.cross(axis, [0.0, 0.0, 1.0]))
        transform = np.round(quarter)  # exact, so that boxes stay boxes
    turned.apply_transform(transform)
    return turned


def _fill(hull: trimesh.Trimesh, axis: int) -> float:
    """Share of its smallest rectangle that a convex body's outline along an axis fills."""
    flat = np.delete(hull.vertices, axis, axis=1)
    outline = MultiPoint(flat).convex_hull
    return float(outline.area / outline.minimum_rotated_rectangle.area)


def _plain(file: Path) -> bool:
    return "nontextured" in file.stem.lower() or file.suffix.lower() in (".stl", ".off")


def _textures(path: Path) -> list[Image.Image]:
    """The textures of an OBJ; loaders leave out those they can't find without a word, here that is an error."""
    found: list[Image.Image] = []
    if path.suffix.lower() == ".obj":
        for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("mtllib "):
                found += _textures_of_mtl(path.parent / line[7:].strip())
    elif path.suffix.lower() == ".gltf":
        try:
            tree = json.loads(path.read_text(encoding="utf-8"))
        except ValueError as error:
            raise AssetError("can't read this mesh", where=path, found=f"no JSON: {error}") from error
        for entry in [*tree.get("images", []), *tree.get("buffers", [])]:
            uri = entry.get("uri", "data:")
            if not uri.startswith("data:") and not (path.parent / unquote(uri)).is_file():
                raise AssetError("a file this mesh names is missing", where=path.parent / unquote(uri))
    return found


def _textures_of_mtl(path: Path) -> list[Image.Image]:
    if not path.is_file():
        raise AssetError("the material file that the mesh names is missing", where=path)
    found: dict[Path, Image.Image] = {}
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        words = line.strip().split(maxsplit=1)
        if len(words) < 2 or words[0].lower() not in COLOUR_MAPS:
            continue
        # options (-s 1 1 1, -clamp on) may stand before the name, and the name may hold spaces
        file = path.parent / re.sub(r"^(-\w+(\s+(on|off|-?[\d.]+))*\s+)+", "", words[1])
        if not file.is_file():
            raise AssetError("the texture file that the material names is missing", where=file, found=path.name)
        try:
            found[file] = Image.open(file)
            found[file].load()
        except (OSError, SyntaxError) as error:
            raise AssetError("can't read the texture", where=file, found=error) from error
    return list(found.values())
