"""Raw scans as assets: one object for each mesh file or subfolder of a folder."""

from __future__ import annotations

import re
import unicodedata
import zlib
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import trimesh

from asset_tools.build import build_object
from asset_tools.pipeline import Job, content_hash
from asset_tools.prepare import prepare
from asset_tools.scan import FORMATS, Unit, Up, find_mesh, guess_unit, guess_units, longest_side
from asset_tools.scan_files import scan_files as resolved_files
from asset_tools.sources import ObjectSource
from robocas_ms3.assets.manifest import ObjectAsset
from robocas_ms3.errors import AssetError

# Filled packages weigh about what water does, half-empty ones and boxes of cereal far less.
DENSITY = 600.0  # kg/m3 of the whole body
MASS_RANGE = (0.03, 0.8)  # kg
BESIDE = {".mtl", ".bin", ".png", ".jpg", ".jpeg", ".bmp", ".tga", ".tif", ".tiff", ".webp"}


@dataclass(frozen=True)
class ImportSettings:
    """How scans are read; the same for all of a folder.

    Attributes:
        units: of the files; none: guessed from all sizes together.
        up: axis that points up in the files; none: guessed for each.
        masses: kg by object id; others are estimated from their volume.
        licence: of the scans.
        attribution: whom to name.
    """

    units: Unit | None = None
    up: Up | None = None
    masses: dict[str, float] = field(default_factory=dict)
    licence: str = "unknown"
    attribution: str = "unknown"


def scan_jobs(source: Path, settings: ImportSettings) -> list[Job]:
    """What is to be made of a folder of scans. One that can't be read is a job that fails when it is its turn.

    Raises:
        AssetError: there are none, or masses are given for others.
    """
    scans = find_scans(source)
    unknown = sorted(set(settings.masses) - set(scans))
    if unknown:
        expected = f"ids among {', '.join(scans)}"
        raise AssetError("masses are given for scans that are not there", expected=expected, found=", ".join(unknown))
    bad: dict[str, AssetError] = {}
    meshes, sides = {}, {}
    for id_, path in scans.items():
        try:
            meshes[id_] = find_mesh(path)
            sides[id_] = longest_side(meshes[id_])
        except AssetError as error:
            bad[id_] = error
    units: dict[str, Unit] = {}
    for id_, side in sides.items():
        try:
            # the others say which unit is usual; one that fits none is bad by itself
            others = {name: length for name, length in sides.items() if _in_some_unit(length)}
            units[id_] = settings.units or guess_units({**others, id_: side})[id_]
        except AssetError as error:
            bad[id_] = error
    jobs = []
    for id_ in scans:
        if id_ in bad:
            jobs.append(Job(id_, partial(_fail, bad[id_]), content_hash(str(bad[id_]))))
            continue
        job = partial(_make, id_, meshes[id_], units[id_], settings)
        facts = (id_, units[id_], settings.up, settings.masses.get(id_), settings.licence, settings.attribution)
        jobs.append(Job(id_, job, content_hash(*facts, files=scan_files(meshes[id_]))))
    return jobs


def find_scans(source: Path) -> dict[str, Path]:
    """Object id -> mesh file or folder: every subfolder and every mesh file in a folder.

    Raises:
        AssetError: no such folder, nothing in it, or two scans with one name.
    """
    if not source.is_dir():
        raise AssetError("no such folder of scans", where=source)
    scans: dict[str, Path] = {}
    for path in sorted(source.iterdir()):
        if path.name.startswith(".") or not (path.is_dir() or path.suffix.lower() in FORMATS):
            continue
        name = object_id(path.stem if path.is_file() else path.name)
        if name in scans:
            raise AssetError("two scans would get the same id", where=path, found=name, fix="Rename one.")
        scans[name] = path
    if not scans:
        raise AssetError("no scans in this folder", where=source, expected="a mesh file or a subfolder per object")
    return scans


def scan_files(mesh: Path) -> list[Path]:
    """The files that a scan may be made of: the mesh, materials and pictures below its folder, textures elsewhere."""
    beside = {path for path in mesh.parent.rglob("*") if path.suffix.lower() in BESIDE and path.is_file()}
    with suppress(AssetError):  # a missing one: said when the scan is read
        beside.update(path.resolve() for path in resolved_files(mesh, []).paths.values())
    return [mesh, *sorted(beside)]


def object_id(name: str) -> str:
    """A name as an id: small letters, digits and underscores; one that has none of these gets a number."""
    plain = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()
    return re.sub(r"[^a-z0-9]+", "_", plain.lower()).strip("_") or f"object_{zlib.crc32(name.encode()):08x}"


def estimate_mass(closed: trimesh.Trimesh) -> float:
    """Mass in kg of a household product of this volume (m3)."""
    return round(min(max(DENSITY * float(closed.volume), MASS_RANGE[0]), MASS_RANGE[1]), 4)


def _in_some_unit(side: float) -> bool:
    try:
        guess_unit([side])
    except AssetError:
        return False
    return True


def _fail(error: AssetError, folder: Path) -> ObjectAsset:
    raise error


def _make(id_: str, path: Path, unit: Unit, settings: ImportSettings, folder: Path) -> ObjectAsset:
    scan = prepare(path, up=settings.up, unit=unit)
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
