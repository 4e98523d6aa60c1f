"""From a textured mesh to a finished asset of a pack: display mesh, hulls, resting poses, grasps, mass properties."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from asset_tools.decompose import Decomposition, decompose, volume_iou
from asset_tools.grasps import sample_grasps
from asset_tools.resting import resting_poses
from asset_tools.visual import to_display, write_glb
from robocas_ms3.assets.hulls import read_hulls, write_hulls
from robocas_ms3.assets.manifest import FurnitureAsset, InnerBox, ObjectAsset, PackManifest, Surface
from robocas_ms3.assets.pack import ANNOTATIONS, HULLS, MANIFEST, VISUAL, Annotations, sha256
from robocas_ms3.errors import AssetError
from robocas_ms3.files import replacing_folder
from robocas_ms3.paths import cache_dir

SURFACE_POINTS = 1024
GRASPS = 800  # many, since of an object on a table most are from below or blocked by neighbours


@dataclass(frozen=True)
class ObjectSource:
    """What an object is made from.

    Attributes:
        id: folder name.
        name: for language.
        category: what kind of thing it is.
        mesh: to look at; textured, metres, z up, any origin.
        closed: watertight mesh of the same body in the same frame, for volume, hulls and grasps.
        mass: kg.
        friction: of its surface.
        source: where the geometry comes from.
        licence: of the mesh.
        attribution: whom to name.
        repairs: what had to be mended.
        graspnet_id: of the object of GraspNet-1Billion that it is or stands in for.
        pieces: (V, 3) corners of convex pieces, in the mesh's frame, where they are known; none: by decomposition.
        grasps: in the mesh's frame, where they are known; none: sampled.
        hollow: a container or a thin thing, whose hulls are judged by distance.
    """

    id: str
    name: str
    category: str
    mesh: trimesh.Trimesh
    closed: trimesh.Trimesh
    mass: float
    friction: float = 0.99
    source: str = "builtin"
    licence: str = "MIT"
    attribution: str = "robocas_ms3"
    repairs: tuple[str, ...] = ()
    graspnet_id: int | None = None
    pieces: list[np.ndarray] | None = None
    grasps: Grasps | None = None
    hollow: bool = False


@dataclass(frozen=True)
class LinkSource:
    """A moving part of a piece of furniture, in the furniture's frame with all joints at 0; metres.

    Attributes:
        name: of the link.
        joint: how it hangs on its parent.
        mesh: to look at.
        pieces: (V, 3) corners of each convex collision piece.
        mass: kg; its centre and inertia are those of the pieces, solid.
        parent: name of another link; empty: the fixed body.
    """

    name: str
    joint: Joint
    mesh: trimesh.Trimesh
    pieces: list[np.ndarray]
    mass: float
    parent: str = ""


@dataclass(frozen=True)
class FurnitureSource:
    """What a piece of furniture is made from; everything in its own frame, metres.

    Attributes:
        id: folder name.
        name: for language.
        category: what kind of thing it is.
        mesh: to look at, of the fixed body.
        pieces: (V, 3) corners of each convex collision piece of the fixed body.
        mass: kg; none: it can't move. Its centre and inertia are those of the pieces, solid.
        origin_height: of the frame above the lowest point.
        surfaces: where objects may stand.
        inner: inside of a container.
        links: moving parts, parents first.
        handles: where to take hold of them.
        finishes: part -> finish -> mesh of that part; the first is the default. Not in ``mesh``.
    """

    id: str
    name: str
    category: str
    mesh: trimesh.Trimesh
    pieces: list[np.ndarray]
    mass: float | None = None
    origin_height: float = 0.0
    surfaces: dict[str, Surface] = field(default_factory=dict)
    inner: InnerBox | None = None
    links: tuple[LinkSource, ...] = ()
    handles: dict[str, Handle] = field(default_factory=dict)
    finishes: dict[str, dict[str, trimesh.Trimesh]] = field(default_factory=dict)
    friction: float = 0.99
    source: str = "builtin"
    licence: str = "MIT"
    attribution: str = "robocas_ms3"
    repairs: tuple[str, ...] = ()


def build_object(source: ObjectSource, folder: Path, *, hull_cache: Path | None = None) -> ObjectAsset:
    """Make an object's files in a folder and say what the manifest says of it. The same source gives the same files.

    The frame's origin becomes the centre of the mesh's bounding box.

    Raises:
        AssetError: naming the object and what can't be done with it.
    """
    try:
        return _build_object(source, folder, hull_cache or cache_dir() / "hulls")
    except AssetError as error:
        raise AssetError(
            error.what, where=source.id, expected=error.expected, found=error.found, fix=error.fix
        ) from error


def _build_object(source: ObjectSource, folder: Path, hull_cache: Path) -> ObjectAsset:
    folder.mkdir(parents=True, exist_ok=True)
    shift = -source.mesh.bounds.mean(axis=0)
    mesh, closed = source.mesh.copy(include_cache=True), source.closed.copy()
    mesh.apply_translation(shift)
    closed.apply_translation(shift)

    write_glb(to_display(mesh), folder / VISUAL)
    if source.pieces is None:
        parts = decompose(closed, cache=hull_cache)
    else:
        pieces = [piece + shift for piece in source.pieces]
        parts = Decomposition(pieces, volume_iou(closed, pieces))
    write_hulls(folder / HULLS, parts.hulls)
    # what the simulator will load: a round thing rests differently on a facet that was rounded away
    hulls = [hull.vertices for hull in read_hulls(folder / HULLS)]

    center = np.asarray(closed.center_mass)
    inertia, axes = principal_inertia(closed, source.mass)
    rest = resting_poses(
        hulls,
        mass=source.mass,
        center_of_mass=center,
        inertia=inertia,
        inertia_wxyz=axes,
        friction=source.friction,
    )
    rng = np.random.default_rng(zlib.crc32(source.id.encode()))
    grasps = sample_grasps(closed, center, rng, count=GRASPS)
    points, faces = trimesh.sample.sample_surface(closed, SURFACE_POINTS, seed=0)[:2]
    Annotations(
        rest.poses,
        rest.probabilities,
        rest.display_pose,
        _light(grasps.tcp_in_object),
        _light(grasps.widths),
        _light(grasps.qualities),
        _light(points),
        _light(closed.face_normals[faces]),
    ).save(folder / ANNOTATIONS)
    return ObjectAsset(
        id=source.id,
        name=source.name,
        category=source.category,
        source=source.source,
        licence=source.licence,
        attribution=source.attribution,
        extents=_triple(mesh.extents),
        friction=source.friction,
        files=_hashes(folder),
        mass=source.mass,
        center_of_mass=_triple(center),
        inertia=_triple(inertia),
        inertia_wxyz=tuple(float(x) for x in axes),  # pyright: ignore[reportArgumentType]
        hull_count=len(parts.hulls),
        volume_iou=round(parts.volume_iou, 4),
        grasp_count=len(grasps.widths),
        repairs=source.repairs,
    )


def build_furniture(source: FurnitureSource, folder: Path) -> FurnitureAsset:
    """Make a piece of furniture's files in a folder and say what the manifest says of it."""
    folder.mkdir(parents=True, exist_ok=True)
    write_glb(source.mesh, folder / VISUAL)
    write_hulls(folder / HULLS, source.pieces)
    return FurnitureAsset(
        id=source.id,
        name=source.name,
        category=source.category,
        source=source.source,
        licence=source.licence,
        attribution=source.attribution,
        extents=_triple(source.mesh.extents),
        friction=source.friction,
        files=_hashes(folder),
        mass=source.mass,
        center_of_mass=source.center_of_mass,
        inertia=source.inertia,
        origin_height=source.origin_height,
        surfaces=source.surfaces or {},
        inner=source.inner,
    )


@contextmanager
def new_pack(folder: Path, *, name: str, description: str = "") -> Iterator[PackWriter]:
    """Write a pack: it appears at ``folder`` when everything in it is done, or not at all."""
    with replacing_folder(folder) as tmp:
        writer = PackWriter(tmp)
        yield writer
        assets = sorted(writer.assets, key=lambda asset: (asset.kind, asset.id))
        manifest = PackManifest(name=name, description=description, assets=assets)
        (tmp / MANIFEST).write_text(manifest.model_dump_json(indent=1) + "\n", encoding="utf-8")


class PackWriter:
    """A pack that is being written.

    Attributes:
        folder: where the assets' folders go.
        assets: those that are done.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.assets: list[ObjectAsset | FurnitureAsset] = []

    def add(self, asset: ObjectAsset | FurnitureAsset) -> None:
        """List an asset whose files lie in ``folder / asset.id``."""
        self.assets.append(asset)


def principal_inertia(closed: trimesh.Trimesh, mass: float) -> tuple[np.ndarray, np.ndarray]:
    """Moments (3,) in kg m2 about the centre of mass and their axes (wxyz) of a solid of even density."""
    tensor = np.asarray(closed.moment_inertia) * (mass / closed.volume)
    moments, vectors = np.linalg.eigh(tensor)
    if np.linalg.det(vectors) < 0:
        vectors[:, 0] *= -1
    xyzw = Rotation.from_matrix(vectors).as_quat()
    return moments, xyzw[[3, 0, 1, 2]]


def _light(values: Any) -> Any:
    """Single precision: half the size on disk, and still a thousandth of a millimetre."""
    return np.asarray(values, dtype=np.float32)


def _hashes(folder: Path) -> dict[str, str]:
    return {path.name: sha256(path) for path in sorted(folder.iterdir()) if path.is_file()}


def _triple(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (round(float(value), 9) for value in values)
    return x, y, z
