"""Reading raw scans: which file, is it whole, in which unit, which way up."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image
from shapely import MultiPoint
from trimesh.visual.material import PBRMaterial

from asset_tools.scan_files import ScanFiles, decode, large_images, scan_files, sound_image
from robocas_ms3.errors import AssetError

Array = NDArray[np.float64]
Unit = Literal["m", "cm", "mm", "inch"]
Up = Literal["x", "y", "z", "-x", "-y", "-z"]

METRES: dict[str, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254}
UPS: tuple[str, ...] = get_args(Up)
FORMATS = (".obj", ".glb", ".gltf", ".ply", ".stl", ".off", ".dae", ".3mf")  # the better first
PLAUSIBLE = (0.005, 1.5)  # m, longest side of a thing that a hand can pick up, generously
TYPICAL = 0.15  # m, longest side of a household object
GIANT = 5.0  # times the typical size: next to scans in another unit, more likely one of ten times smaller things
FAR = np.log(20)  # from the typical size, where a scan no longer tells what unit the others have
STANDS = 0.27  # thickness over height down to which people put a box on its end
BOX_FILL = 0.93  # share of its rectangle that a box's outline fills; an ellipse fills 0.785


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


def load_scan(path: Path, repairs: list[str] | None = None) -> trimesh.Trimesh:
    """Load a scan with its colours, as it is: unit and axes are the file's.

    Args:
        path: of the mesh, or of a folder with one.
        repairs: gets a line for each thing that had to be mended: files not where they should be, huge textures.

    Raises:
        AssetError: the file is missing, damaged, empty, of no size or not finite, or a texture it names is missing.
    """
    path, repairs = find_mesh(path), [] if repairs is None else repairs
    files = scan_files(path, repairs)
    try:
        data = path.read_bytes()
        if path.suffix.lower() == ".obj":
            data = decode(data).encode()  # as the names of the materials were read
        with large_images():
            loaded = trimesh.load_scene(io.BytesIO(data), path.suffix.lower()[1:], resolver=files, process=False)
            _mend_textures(loaded, path, files, repairs)
            mesh = _as_one(loaded)
    except AssetError:
        raise
    except Exception as error:  # the loaders raise whatever their parsing runs into
        found = " ".join(f"{type(error).__name__}: {error}".split())
        raise AssetError("can't read this mesh", where=path, found=found) from error
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0 or len(mesh.vertices) == 0:
        raise AssetError("the mesh is empty", where=path, expected="triangles", found="none")
    if not np.isfinite(mesh.vertices).all():
        bad = int((~np.isfinite(mesh.vertices)).any(axis=1).sum())
        raise AssetError(
            "the mesh has vertices that are not finite", where=path, found=f"{bad} of {len(mesh.vertices)}"
        )
    if np.ptp(mesh.vertices[mesh.faces].reshape(-1, 3), axis=0).max() <= 0:
        raise AssetError("the mesh has no size", where=path, found="all vertices in one point")
    return mesh


def longest_side(path: Path) -> float:
    """Longest side of a scan, in its unit; textures are not looked at.

    Raises:
        AssetError: as `load_scan`.
    """
    if path.suffix.lower() != ".obj":
        return float(load_scan(path).extents.max())
    words = [line.split(maxsplit=4)[1:4] for line in path.read_bytes().splitlines() if line.startswith(b"v ")]
    try:
        points = np.array(words, dtype=float).reshape(-1, 3)
    except ValueError as error:
        raise AssetError("can't read this mesh", where=path, found=error) from error
    if len(points) == 0:
        raise AssetError("the mesh is empty", where=path, expected="triangles", found="none")
    return float(np.ptp(points, axis=0).max())


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


def guess_units(longest: Mapping[str, float]) -> dict[str, Unit]:
    """The unit of each scan of a folder: that of most of them, save for those that it makes giants or crumbs.

    Args:
        longest: longest side of each scan, in its unit, by its name.

    Raises:
        AssetError: a scan is in no unit of a size that can be picked up.
    """
    cost = {
        unit: sum(min(abs(np.log(side * METRES[unit] / TYPICAL)), FAR) for side in longest.values())
        for unit in ("m", "cm", "mm")
    }
    usual: Any = min(cost, key=lambda unit: cost[unit])
    units: dict[str, Unit] = {}
    for name, side in longest.items():
        fits = PLAUSIBLE[0] <= side * METRES[usual] <= GIANT * TYPICAL
        try:
            units[name] = usual if fits else guess_unit([side])
        except AssetError as error:
            raise AssetError(
                error.what, where=name, expected=error.expected, found=error.found, fix=error.fix
            ) from error
    return units


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
    turned = mesh.copy(include_cache=True)  # with its normals
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


def _as_one(loaded: trimesh.Scene) -> Any:
    """A scene's mesh; one alone keeps its normals, which joining would drop."""
    if len(loaded.geometry) == 0:
        return trimesh.Trimesh()
    nodes = loaded.graph.nodes_geometry
    if len(nodes) == 1:
        transform, name = loaded.graph[nodes[0]]
        if np.array_equal(transform, np.eye(4)):
            return loaded.geometry[name]
    return loaded.to_mesh()


def _mend_textures(loaded: trimesh.Scene, path: Path, files: ScanFiles, repairs: list[str]) -> None:
    """Textures of a loaded scene read, of a useful size, and where the file meant them to be."""
    done: dict[int, Image.Image] = {}
    parts: list[Any] = [part for part in loaded.geometry.values() if isinstance(part, trimesh.Trimesh)]
    for part in parts:
        material: Any = getattr(part.visual, "material", None)
        name = "baseColorTexture" if isinstance(material, PBRMaterial) else "image"
        image = getattr(material, name, None)
        if image is not None:
            if id(image) not in done:
                done[id(image)] = sound_image(image, files.paths.get(image.info.get("file_path", ""), path), repairs)
            setattr(material, name, done[id(image)])
        elif material is not None and len(files.paths) == 1 and material.name not in files.materials:
            only = next(iter(files.paths))
            with Image.open(files.paths[only]) as opened:
                done[id(material)] = sound_image(opened, files.paths[only], repairs)
            setattr(material, name, done[id(material)])
            repairs.append(f"took the only texture, {files.paths[only].name}, for faces without a material")
    if parts and files.textured and not done:
        raise AssetError("can't read the texture", where=path, expected="an image, and vertices with UV coordinates")
