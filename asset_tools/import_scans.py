"""Raw scans as assets: one object for each mesh file or subfolder of a folder."""

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
from asset_tools.pipeline import AssetJob, content_hash, make_failing_job
from asset_tools.prepare import prepare_scan
from asset_tools.readers.choice import is_collision, is_mesh
from asset_tools.readers.files import files_below
from asset_tools.scan import Unit, Up, guess_unit, guess_units
from asset_tools.sources import ObjectSource
from robocas_ms3.assets.manifest import ObjectAsset
from robocas_ms3.core.errors import AssetError

# Filled packages weigh about what water does, half-empty ones and boxes of cereal far less.
DENSITY = 600.0  # kg/m3 of the whole body
MASS_RANGE = (0.03, 0.8)  # kg
LONGEST_ID = 50
# mesh formats that are not read; a folder with one of them is an object, not a folder of textures
UNREAD = {".fbx", ".blend", ".usd", ".usda", ".usdc", ".usdz", ".3ds", ".max", ".ma", ".mb", ".step", ".stp", ".wrl"}


@dataclass(frozen=True)
class ImportSettings:
    """How scans are read; the same for all of a folder.

    Attributes:
        units: of the files; None: guessed from all sizes together.
        up: axis that points up in the files; None: guessed for each.
        masses: kg by object id; others are estimated from their volume.
        licence: of the scans.
        attribution: whom to name.
    """

    units: Unit | None = None
    up: Up | None = None
    masses: dict[str, float] = field(default_factory=dict)
    licence: str = "unknown"
    attribution: str = "unknown"


@dataclass
class FoundScans:
    """The scans of a folder.

    Attributes:
        models: by object id.
        errors: why an id can't be imported.
        skipped: what is no scan, with the reason, a line each.
    """

    models: dict[str, ModelSource] = field(default_factory=dict)
    errors: dict[str, AssetError] = field(default_factory=dict)
    skipped: list[str] = field(default_factory=list)


def scan_jobs(
    source: Path,
    settings: ImportSettings,
    inspect: Inspect = inspect_models,
    on_skipped: Callable[[str], None] = lambda reason: None,
) -> list[AssetJob]:
    """Return the jobs that import a folder of scans. One that can't be read is a job that fails when it is its turn.

    Args:
        source: the folder.
        settings: how scans are read.
        inspect: looks at the models first; `inspect_models` with its options.
        on_skipped: called with each entry of the folder that is no scan, and the reason.

    Raises:
        AssetError: there are none, or masses are given for others.
    """
    scans = find_scans(source)
    for reason in scans.skipped:
        on_skipped(reason)
    ids = sorted([*scans.models, *scans.errors])
    unknown = sorted(set(settings.masses) - set(ids))
    if unknown:
        expected = f"ids among {', '.join(ids)}"
        raise AssetError("masses are given for scans that are not there", expected=expected, found=", ".join(unknown))
    inspected = inspect(scans.models)
    errors = {**scans.errors, **{id_: found.error for id_, found in inspected.items() if found.error is not None}}
    units: dict[str, Unit] = {}
    # a scan that fits no unit says nothing about which one is usual
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
        jobs.append(AssetJob(id_, make, content_hash(*facts, files=inspected[id_].files)))
    return jobs


def find_scans(source: Path) -> FoundScans:
    """Find the scans of a folder: every subfolder with a mesh in it, and every mesh file.

    Files of one name, such as ``mug.obj`` and ``mug.stl``, are versions of one object.

    Raises:
        AssetError: there is no such folder, or no scan in it.
    """
    if source.exists() and not source.is_dir():
        raise AssetError(
            "not a folder", where=source, expected="a folder of scans", fix="Give the folder that holds it."
        )
    if not source.is_dir():
        raise AssetError("no such folder of scans", where=source)
    found = FoundScans()
    entries = [path for path in sorted(source.iterdir()) if not path.name.startswith(".")]
    meshes = [path for path in entries if is_mesh(path)]
    shown = [path for path in meshes if not is_collision(path, source)]
    if shown:
        found.skipped += [f"{path.name}: a collision mesh" for path in meshes if path not in shown]
    versions: dict[str, list[Path]] = {}
    for path in shown or meshes:
        versions.setdefault(object_id(path.stem), []).append(path)
    found.models = {id_: ModelSource(tuple(paths), source) for id_, paths in versions.items()}
    for path in entries:
        if not path.is_dir():
            continue
        reason, name = _no_scan(path), object_id(path.name)
        if reason:
            found.skipped.append(f"{path.name}/: {reason}")
        elif name in found.models or name in found.errors:
            found.models.pop(name, None)
            found.errors[name] = AssetError(
                "two scans would get the same id", where=path, found=name, fix="Rename one."
            )
        else:
            found.models[name] = ModelSource((path,), source)
    if not found.models and not found.errors:
        expected = "a mesh file or a subfolder per object"
        raise AssetError("no scans in this folder", where=source, expected=expected, found="; ".join(found.skipped))
    return found


def object_id(name: str) -> str:
    """Return a name as an id: small letters, digits and underscores; one without any, or too long, gets a number."""
    plain = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()
    id_, number = re.sub(r"[^a-z0-9]+", "_", plain.lower()).strip("_"), f"{zlib.crc32(os.fsencode(name)):08x}"
    return f"{id_[:LONGEST_ID]}_{number}" if len(id_) > LONGEST_ID else id_ or f"object_{number}"


def estimate_mass(closed: trimesh.Trimesh) -> float:
    """Return the mass in kg of a household product of this volume (m3)."""
    return round(min(max(DENSITY * float(closed.volume), MASS_RANGE[0]), MASS_RANGE[1]), 4)


def _no_scan(folder: Path) -> str:
    """Return why a folder is no object; empty: it is one."""
    if folder.name.lower() == "__macosx":
        return "what macOS adds to archives"
    if any(is_mesh(path) or path.suffix.lower() in UNREAD for path in files_below(folder)):
        return ""
    return "no mesh is in it"


def _in_some_unit(side: float) -> bool:
    try:
        guess_unit([side])
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
