"""Asset packs, read and checked: see ``manifest.py`` for the format. Needs no SAPIEN."""

from __future__ import annotations

import hashlib
import zipfile
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path

import numpy as np
from pydantic import ValidationError
from scipy.spatial import ConvexHull

from robocas_ms3.assets.hulls import Array, Hull, read_hulls, sample_surface
from robocas_ms3.assets.manifest import FurnitureAsset, ObjectAsset, PackManifest
from robocas_ms3.errors import AssetError
from robocas_ms3.paths import builtin_packs_dir, data_dir

MANIFEST, VISUAL, HULLS, ANNOTATIONS = "manifest.json", "visual.glb", "hulls.obj", "annotations.npz"

# (path, size, mtime) -> sha256, so that only changed files are read again within a process
_hashes: dict[tuple[str, int, int], str] = {}
# (manifest path, size, mtime) -> pack, so that its lazy geometry is worked out once a process
_packs: dict[tuple[str, int, int], Pack] = {}


@dataclass(frozen=True)
class Annotations:
    """What is known of an object besides its shape. S stable poses, G grasps, P surface points; metres, asset frame.

    Attributes:
        resting_poses: (S, 4, 4) ``T_plane_object``: the object's frame in a frame whose z = 0 is the plane it rests
            on, its centre of mass at x = y = 0.
        resting_probabilities: (S,) share of random drops that end in each pose; they sum to 1.
        display_pose: index of the pose in which the object stands upright, or -1.
        grasps_tcp_in_object: (G, 4, 4) TCP poses, z approach, y closing, origin midway between the finger tips.
        grasp_widths: (G,) finger opening the object needs, m.
        grasp_qualities: (G,) lowest friction coefficient that closes the grasp; smaller is better.
        surface_points: (P, 3) points on the visual mesh.
        surface_normals: (P, 3) their outward unit normals.
    """

    resting_poses: Array
    resting_probabilities: Array
    display_pose: int
    grasps_tcp_in_object: Array
    grasp_widths: Array
    grasp_qualities: Array
    surface_points: Array
    surface_normals: Array

    def __post_init__(self) -> None:
        poses, grasps, points = len(self.resting_poses), len(self.grasp_widths), len(self.surface_points)
        shapes = {
            "resting_poses": (poses, 4, 4),
            "resting_probabilities": (poses,),
            "grasps_tcp_in_object": (grasps, 4, 4),
            "grasp_widths": (grasps,),
            "grasp_qualities": (grasps,),
            "surface_points": (points, 3),
            "surface_normals": (points, 3),
        }
        for name, shape in shapes.items():
            found = getattr(self, name)
            if found.shape != shape or not np.isfinite(found).all():
                raise AssetError("wrong shape or non-finite numbers", where=name, expected=shape, found=found.shape)
        if poses == 0 or not -1 <= self.display_pose < poses:
            raise AssetError("no such resting pose", where="display_pose", found=f"{self.display_pose} of {poses}")

    def save(self, path: Path) -> None:
        """Write ``annotations.npz``."""
        np.savez_compressed(path, **{f.name: np.asarray(getattr(self, f.name)) for f in fields(self)})

    @classmethod
    def load(cls, path: Path) -> Annotations:
        """Read ``annotations.npz``.

        Raises:
            AssetError: it is damaged, or an array is missing or has the wrong shape.
        """
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays = {f.name: file[f.name] for f in fields(cls)}
        except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
            raise AssetError(
                "can't read the annotations", where=path, found=error, fix="Make the pack again."
            ) from error
        for array in arrays.values():
            array.setflags(write=False)
        try:
            return cls(**{**arrays, "display_pose": int(arrays["display_pose"])})
        except AssetError as error:
            raise AssetError(str(error), where=path, fix="Make the pack again.") from error


@dataclass(frozen=True)
class LoadedAsset:
    """Files and collision geometry of an asset.

    Attributes:
        folder: where its files lie.
    """

    folder: Path
    _points: dict[float, Array] = field(default_factory=dict, repr=False, compare=False)

    @property
    def visual_path(self) -> Path:
        """The textured mesh (GLB)."""
        return self.folder / VISUAL

    @property
    def hulls_path(self) -> Path:
        """The convex hulls (OBJ, one group each)."""
        return self.folder / HULLS

    @cached_property
    def hull_meshes(self) -> list[Hull]:
        """The convex hulls with their faces, in the asset's frame."""
        return read_hulls(self.hulls_path)

    @property
    def hulls(self) -> list[Array]:
        """The vertices (V, 3) of each convex hull, m, in the asset's frame."""
        return [hull.vertices for hull in self.hull_meshes]

    def surface_points(self, spacing: float = 0.005) -> Array:
        """Points (P, 3) on the surface of the hulls' union, m, in the asset's frame; the same on every call.

        Args:
            spacing: distance between neighbours, roughly, m.
        """
        if spacing not in self._points:
            points = sample_surface(self.hull_meshes, spacing)
            points.setflags(write=False)
            self._points[spacing] = points
        return self._points[spacing]


@dataclass(frozen=True)
class LoadedObject(LoadedAsset):
    """A thing to pick up.

    Attributes:
        asset: its entry in the manifest.
    """

    asset: ObjectAsset = field(kw_only=True)

    @cached_property
    def annotations(self) -> Annotations:
        """Resting poses, grasps and surface points."""
        return Annotations.load(self.folder / ANNOTATIONS)

    def footprint(self, pose_index: int) -> Array:
        """What the object covers when it rests in a pose.

        Args:
            pose_index: row of ``annotations.resting_poses``.

        Returns:
            (K, 2) convex polygon around the centre of mass, counter-clockwise, m.
        """
        pose = self.annotations.resting_poses[pose_index]
        flat = np.concatenate(self.hulls) @ pose[:2, :3].T + pose[:2, 3]
        return flat[ConvexHull(flat).vertices]


@dataclass(frozen=True)
class LoadedFurniture(LoadedAsset):
    """Scenery.

    Attributes:
        asset: its entry in the manifest.
    """

    asset: FurnitureAsset = field(kw_only=True)


@dataclass(frozen=True)
class Pack:
    """An asset pack, checked.

    Attributes:
        name: as in the manifest.
        root: its folder.
        manifest: what it says of itself.
        objects: things to pick up, by id.
        furniture: scenery, by id.
    """

    name: str
    root: Path
    manifest: PackManifest
    objects: dict[str, LoadedObject]
    furniture: dict[str, LoadedFurniture]


def pack_folders() -> dict[str, Path]:
    """Every pack there is: its name and folder, the shipped ones first; a user's pack can't hide a shipped one."""
    found: dict[str, Path] = {}
    for parent in (builtin_packs_dir(), data_dir() / "packs"):
        if parent.is_dir():
            for folder in sorted(parent.iterdir()):
                if (folder / MANIFEST).is_file() and not folder.name.startswith("."):
                    found.setdefault(folder.name, folder)
    return found


def available_packs() -> list[str]:
    """Names of the packs that `load_pack` knows without a path."""
    return list(pack_folders())


def load_pack(name_or_path: str | Path) -> Pack:
    """Load and verify a pack.

    Args:
        name_or_path: name of a shipped or imported pack, or the folder of one.

    Raises:
        AssetError: there is no such pack, or a file of it is missing, changed or damaged.
    """
    folder = pack_folders().get(str(name_or_path))
    if folder is None:
        folder = Path(name_or_path)
        if not (folder / MANIFEST).is_file():
            raise AssetError(
                "no such asset pack",
                where=name_or_path,
                expected=f"one of {', '.join(available_packs()) or '(none)'}, or a folder with a {MANIFEST}",
                fix="See `robocas assets list`, or make one with `robocas assets import-scans`.",
            )
    folder = folder.resolve()
    path = folder / MANIFEST
    status = path.stat()
    key = (str(path), status.st_size, status.st_mtime_ns)
    if key not in _packs:
        _packs[key] = _read(folder, path)
    verify(_packs[key])
    return _packs[key]


def verify(pack: Pack) -> None:
    """Check that every file the manifest lists is there and unchanged. A file is read once per process and change.

    Raises:
        AssetError: naming the file, and whether it is missing, cut short or changed.
    """
    for asset in pack.manifest.assets:
        for name, expected in asset.files.items():
            path = pack.root / asset.id / name
            fix = f"Restore the file, or make the pack {pack.name!r} again."
            if not path.is_file():
                raise AssetError("this file of the asset pack is missing", where=path, fix=fix)
            if path.stat().st_size == 0:
                raise AssetError("this file of the asset pack is empty", where=path, fix=fix)
            found = sha256(path)
            if found != expected:
                raise AssetError(
                    "this file of the asset pack was changed or cut short",
                    where=path,
                    expected=f"sha256 {expected[:12]}...",
                    found=f"{found[:12]}...",
                    fix=fix,
                )


def sha256(path: Path) -> str:
    """Hash of a file, from memory if its size and time of change are those of the last call."""
    status = path.stat()
    key = (str(path), status.st_size, status.st_mtime_ns)
    if key not in _hashes:
        with path.open("rb") as file:
            digest = hashlib.sha256()
            while block := file.read(1 << 20):
                digest.update(block)
        _hashes[key] = digest.hexdigest()
    return _hashes[key]


def _read(folder: Path, path: Path) -> Pack:
    try:
        manifest = PackManifest.model_validate_json(path.read_bytes())
    except ValidationError as error:
        first = error.errors()[0]
        raise AssetError(
            "the manifest is damaged",
            where=path,
            expected=first["msg"],
            found=f"at {'.'.join(map(str, first['loc'])) or 'the top'}",
            fix="Make the pack again.",
        ) from error
    objects, furniture = {}, {}
    for asset in manifest.assets:
        if asset.id in objects or asset.id in furniture:
            raise AssetError("two assets of the pack have the same id", where=path, found=asset.id)
        for name in _required(asset):
            if name not in asset.files:
                raise AssetError("the manifest lists no such file", where=path, expected=f"{asset.id}/{name}")
        if isinstance(asset, ObjectAsset):
            objects[asset.id] = LoadedObject(folder / asset.id, asset=asset)
        else:
            furniture[asset.id] = LoadedFurniture(folder / asset.id, asset=asset)
    return Pack(manifest.name, folder, manifest, objects, furniture)


def _required(asset: ObjectAsset | FurnitureAsset) -> tuple[str, ...]:
    return (VISUAL, HULLS, ANNOTATIONS) if isinstance(asset, ObjectAsset) else (VISUAL, HULLS)
