"""Import a folder of raw scans as an asset pack: one object a mesh file or subfolder."""

from __future__ import annotations

import re
import shutil
import unicodedata
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from multiprocessing import get_context
from pathlib import Path

import trimesh
from scipy.spatial import QhullError

from asset_tools.build import ObjectSource, build_object, new_pack
from asset_tools.repair import close
from asset_tools.scan import FORMATS, METRES, Unit, Up, find_mesh, guess_unit, guess_up, load_scan, upright
from robocas_ms3.assets.manifest import ObjectAsset
from robocas_ms3.errors import AssetError

# Filled packages weigh about what water does, half-empty ones and boxes of cereal far less.
DENSITY = 600.0  # kg/m3 of the whole body
MASS_RANGE = (0.03, 0.8)  # kg


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


@dataclass(frozen=True)
class Imported:
    """What became of one scan.

    Attributes:
        id: of the object.
        asset: its entry in the manifest; none where it failed.
        error: why it failed.
        up: axis of the file that was taken for up.
    """

    id: str
    asset: ObjectAsset | None
    error: str = ""
    up: str = ""


def import_scans(
    source: Path,
    out: Path,
    settings: ImportSettings,
    *,
    jobs: int = 2,
    skip_bad: bool = False,
    on_result: Callable[[Imported], None] = lambda result: None,
) -> list[Imported]:
    """Import every scan of a folder; the pack appears at ``out`` when all are done, or not at all.

    Args:
        source: folder with a mesh file or a subfolder for each object.
        out: folder of the new pack; its name is the pack's.
        settings: how the scans are read.
        jobs: processes.
        skip_bad: leave out scans that can't be imported, instead of giving up.
        on_result: called after each scan.

    Raises:
        AssetError: a scan can't be imported, naming it and why; or there are none.
    """
    scans = find_scans(source)
    units = settings.units or guess_unit([longest_side(path) for path in scans.values()])
    results = []
    with new_pack(out, name=out.name, description=f"{len(scans)} scans") as pack:
        for result in _run([(id_, path, pack.folder, settings, units) for id_, path in scans.items()], jobs):
            if result.asset is None and not skip_bad:
                raise AssetError(result.error, fix="Mend it, or pass --skip-bad to leave it out.")
            if result.asset is not None:
                pack.add(result.asset)
            results.append(result)
            on_result(result)
        if not pack.assets:
            raise AssetError("none of the scans could be imported", where=source)
    return results


def find_scans(source: Path) -> dict[str, Path]:
    """Object id -> mesh file, of every subfolder with a mesh and every mesh file in a folder.

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
        scans[name] = find_mesh(path)
    if not scans:
        raise AssetError("no scans in this folder", where=source, expected="a mesh file or a subfolder per object")
    return scans


def object_id(name: str) -> str:
    """A name as an id: small letters, digits and underscores."""
    plain = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()
    return re.sub(r"[^a-z0-9]+", "_", plain.lower()).strip("_") or "object"


def longest_side(path: Path) -> float:
    """Longest side of a mesh's bounding box, in its unit."""
    return float(load_scan(path).extents.max())


def estimate_mass(closed: trimesh.Trimesh) -> float:
    """Mass in kg of a household product of this volume (m3)."""
    return round(min(max(DENSITY * float(closed.volume), MASS_RANGE[0]), MASS_RANGE[1]), 4)


def _run(tasks: list[tuple], jobs: int) -> Iterator[Imported]:
    if jobs <= 1:
        yield from (_import_one(*task) for task in tasks)
        return
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        futures = [pool.submit(_import_one, *task) for task in tasks]
        try:
            yield from (future.result() for future in futures)
        finally:
            pool.shutdown(cancel_futures=True)


def _import_one(id_: str, path: Path, parent: Path, settings: ImportSettings, units: Unit) -> Imported:
    try:
        scan = load_scan(path)
        up: Up = settings.up or guess_up(scan, path.suffix)
        mesh = upright(scan, up)
        mesh.apply_scale(METRES[units])
        solid = close(mesh)
        source = ObjectSource(
            id=id_,
            name=id_.replace("_", " "),
            category="scan",
            mesh=mesh,
            closed=solid.mesh,
            mass=settings.masses.get(id_) or estimate_mass(solid.mesh),
            source="scan",
            licence=settings.licence,
            attribution=settings.attribution,
            repairs=solid.repairs,
        )
        return Imported(id_, build_object(source, parent / id_), up=up)
    except (AssetError, QhullError) as error:
        if isinstance(error, QhullError):
            error = AssetError("the scan is flat or has too few points", where=path, expected="a closed body")
        shutil.rmtree(parent / id_, ignore_errors=True)
        message = str(error)
        return Imported(id_, None, message if id_ in message or str(path) in message else f"{id_}: {message}")
