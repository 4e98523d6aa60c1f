"""Import raw scans as objects: one object for each mesh file or subfolder of a folder."""

from __future__ import annotations

import os
import re
import unicodedata
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import trimesh

from asset_tools.build import build_object
from asset_tools.inspection import Inspect, ModelSource, inspect_models
from asset_tools.pipeline import AssetJob, compute_content_hash, make_failing_job
from asset_tools.prepare import prepare_scan
from asset_tools.readers.choice import is_collision_mesh, is_mesh_file
from asset_tools.readers.files import find_files
from asset_tools.scan import Unit, Up, guess_common_unit, guess_units
from asset_tools.sources import ObjectSource
from robocas_ms3.assets.manifest import ObjectAsset
from robocas_ms3.core.errors import AssetError

# filled packages have about the density of water; half-empty ones and boxes of cereal far less
DENSITY = 600.0  # kg/m3 of the whole body
MASS_RANGE = (0.03, 0.8)  # kg
LONGEST_ID = 50
# unsupported mesh formats; a folder with such a file is an object, not a folder of textures
UNREAD = {".fbx", ".blend", ".usd", ".usda", ".usdc", ".usdz", ".3ds", ".max", ".ma", ".mb", ".step", ".stp", ".wrl"}


@dataclass(frozen=True)
class ImportSettings:
    """Settings for importing a folder of scans.

    Attributes:
        units: unit of the files; None: guessed from the sizes of all scans.
        up: axis of the files that points up; None: guessed for each scan.
        masses: masses in kg by object id; other masses are estimated from the volume.
        licence: licence of the scans.
        attribution: credit for the scans.
    """

    units: Unit | None = None
    up: Up | None = None
    masses: dict[str, float] = field(default_factory=dict)
    licence: str = "unknown"
    attribution: str = "unknown"


@dataclass
class ScanFolder:
    """Content of a folder of scans.

    Attributes:
        models: object id -> paths of the scan.
        errors: object id -> error, for entries that cannot be imported.
        skipped: one line for each entry that is not a scan, with the reason.
    """

    models: dict[str, ModelSource] = field(default_factory=dict)
    errors: dict[str, AssetError] = field(default_factory=dict)
    skipped: list[str] = field(default_factory=list)


def make_scan_jobs(
    source: Path,
    settings: ImportSettings,
    inspect: Inspect = inspect_models,
    on_skipped: Callable[[str], None] = lambda reason: None,
) -> list[AssetJob]:
    """Return one job per scan of a folder; the job of an unreadable scan raises an error when it runs.

    Args:
        source: the folder of scans.
        settings: settings of the import.
        inspect: function that inspects all models: `inspect_models` with chosen options.
        on_skipped: called with a reason for each entry that is not a scan.

    Raises:
        AssetError: the folder has no scans, or masses are given for unknown scans.
    """
    scans = find_scans(source)
    for reason in scans.skipped:
        on_skipped(reason)
    ids = sorted([*scans.models, *scans.errors])
    unknown = sorted(set(settings.masses) - set(ids))
    if unknown:
        expected = f"ids among {', '.join(ids)}"
        raise AssetError("masses are given for unknown scans", expected=expected, found=", ".join(unknown), usage=True)
    inspected = inspect(scans.models)
    errors = {**scans.errors, **{id_: found.error for id_, found in inspected.items() if found.error is not None}}
    units: dict[str, Unit] = {}
    # scans that fit no unit do not take part in the guess
    sides = {id_: found.longest for id_, found in inspected.items() if id_ not in errors}
    usual = {id_: side for id_, side in sides.items() if _in_some_unit(side)}
    for id_, side in sides.items():
        try:
            units[id_] = settings.units or guess_units({**usual, id_: side})[id_]
        except AssetError as error:
            errors[id_] = error
    jobs = []
    for id_ in ids:
        if id_ in errors:
            jobs.append(make_failing_job(id_, errors[id_]))
            continue
        make = partial(_make, id_, scans.models[id_], units[id_], settings)
        facts = (id_, units[id_], settings.up, settings.masses.get(id_), settings.licence, settings.attribution)
        jobs.append(AssetJob(id_, make, compute_content_hash(*facts, files=inspected[id_].files)))
    return jobs


def find_scans(source: Path) -> ScanFolder:
    """Find the scans of a folder: mesh files, and subfolders with meshes.

    Files with the same stem, such as ``mug.obj`` and ``mug.stl``, are versions of one object.

    Raises:
        AssetError: the folder does not exist, or has no scans.
    """
    if source.exists() and not source.is_dir():
        raise AssetError(
            "not a folder", where=source, expected="a folder of scans", fix="Pass the folder that contains this file."
        )
    if not source.is_dir():
        raise AssetError("no such folder of scans", where=source, fix="Check the path.")
    found = ScanFolder()
    entries = [path for path in sorted(source.iterdir()) if not path.name.startswith(".")]
    meshes = [path for path in entries if is_mesh_file(path)]
    shown = [path for path in meshes if not is_collision_mesh(path, source)]
    if shown:
        found.skipped += [f"{path.name}: a collision mesh" for path in meshes if path not in shown]
    versions: dict[str, list[Path]] = {}
    for path in shown or meshes:
        versions.setdefault(make_object_id(path.stem), []).append(path)
    found.models = {id_: ModelSource(tuple(paths), source) for id_, paths in versions.items()}
    for path in entries:
        if not path.is_dir():
            continue
        reason, name = _no_scan(path), make_object_id(path.name)
        if reason:
            found.skipped.append(f"{path.name}/: {reason}")
        elif name in found.models or name in found.errors:
            found.models.pop(name, None)
            found.errors[name] = AssetError(
                "two scans have the same id", where=path, found=name, fix="Rename one of the two scans."
            )
        else:
            found.models[name] = ModelSource((path,), source)
    if not found.models and not found.errors:
        expected = "a mesh file or a subfolder per object"
        contained = "; ".join(found.skipped) or "no meshes"
        raise AssetError("no scans in this folder", where=source, expected=expected, found=contained)
    return found


def make_object_id(name: str) -> str:
    """Convert a file name to an object id of lower-case letters, digits and underscores.

    An empty id, or an id of more than 50 characters, gets a checksum of the name at the end.
    """
    plain = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()
    id_, number = re.sub(r"[^a-z0-9]+", "_", plain.lower()).strip("_"), f"{zlib.crc32(os.fsencode(name)):08x}"
    return f"{id_[:LONGEST_ID]}_{number}" if len(id_) > LONGEST_ID else id_ or f"object_{number}"


def estimate_mass(closed: trimesh.Trimesh) -> float:
    """Estimate the mass of a product in kg from its volume: 600 kg/m3, limited to 0.03 to 0.8 kg."""
    return round(min(max(DENSITY * float(closed.volume), MASS_RANGE[0]), MASS_RANGE[1]), 4)


def _no_scan(folder: Path) -> str:
    """Return the reason why a folder is not a scan; empty if it is a scan."""
    if folder.name.lower() == "__macosx":
        return "a folder that macOS adds to archives"
    if any(is_mesh_file(path) or path.suffix.lower() in UNREAD for path in find_files(folder)):
        return ""
    return "no mesh in this folder"


def _in_some_unit(side: float) -> bool:
    try:
        guess_common_unit([side])
    except AssetError:
        return False
    return True


def _make(id_: str, model: ModelSource, unit: Unit, settings: ImportSettings, folder: Path) -> ObjectAsset:
    scan = prepare_scan(model.paths, root=model.root, up=settings.up, unit=unit)
    source = ObjectSource(
        id=id_,
        name=id_.replace("_", " "),
        category="scan",
        mesh=scan.mesh,
        closed=scan.closed,
        mass=settings.masses[id_] if id_ in settings.masses else estimate_mass(scan.closed),
        source="scan",
        licence=settings.licence,
        attribution=settings.attribution,
        repairs=scan.repairs,
    )
    return build_object(source, folder)
