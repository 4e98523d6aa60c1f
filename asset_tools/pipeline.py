"""Making many assets: in parallel, each kept by the content it was made from, so that what is done is never redone."""

from __future__ import annotations

import hashlib
import logging
import re
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, partial
from importlib.metadata import version
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from robocas_ms3.assets.cooked_hulls import find_hull_violations
from robocas_ms3.assets.manifest import (
    SCHEMA_VERSION,
    Asset,
    FurnitureAsset,
    ObjectAsset,
    PackManifest,
    check_asset_name,
)
from robocas_ms3.assets.pack import MANIFEST, sha256
from robocas_ms3.core.documents import load_json
from robocas_ms3.core.errors import AssetError, RobocasError
from robocas_ms3.core.files import atomic_folder, write_json
from robocas_ms3.core.output_folder import check_replaceable
from robocas_ms3.core.strict_model import validate_json
from robocas_ms3.core.workers import FunctionWorker, WorkerPool

MADE_FROM = "made_from.json"  # of a pack: asset id -> hash of what it was made from
ENTRY = "asset.json"  # what the manifest says of a kept asset; written last
CACHE_DAYS = 60  # an asset that wasn't asked for in this time is made again
TOOLS = ("coacd", "trimesh", "manifold3d", "numpy", "scipy", "sapien", "xatlas", "fast-simplification", "embreex") + (
    "pillow",
    "scikit-image",
    "shapely",
)
SKIP_FIX = "Pass --skip-errors to leave it out."
PACK_NAME = r"[a-z0-9_\-]+"
UNRELATED_FILES = (
    "inspection",
    "pipeline",
    "contact_sheet",
    "renderer",
)  # modules that do not affect the files of an asset

log = logging.getLogger(__name__)

_ASSET: TypeAdapter[ObjectAsset | FurnitureAsset] = TypeAdapter(Asset)


@dataclass(frozen=True)
class AssetJob:
    """An asset to make.

    Attributes:
        id: of the asset.
        make: makes its files in a folder and says what the manifest says of it; must survive pickling.
        content: hash of everything the asset depends on besides this code, see `content_hash`.
        error: why it can't be made, where that is known beforehand.
    """

    id: str
    make: Callable[[Path], ObjectAsset | FurnitureAsset]
    content: str
    error: AssetError | None = None

    def __post_init__(self) -> None:
        check_asset_name(self.id, "an asset's id")


@dataclass(frozen=True)
class AssetJobResult:
    """What became of a job.

    Attributes:
        id: of the asset.
        asset: its entry in the manifest; none where it failed.
        error: why it failed.
        reused: it was made before, of the same content.
        seconds: that making it took.
    """

    id: str
    asset: ObjectAsset | FurnitureAsset | None
    error: str = ""
    reused: bool = False
    seconds: float = 0.0


def make_failing_job(id_: str, error: AssetError) -> AssetJob:
    """Return a job that raises an error when it is its turn, so that it can be left out as any other."""
    return AssetJob(id_, partial(_fail, error), content_hash(str(error)), error)


def _fail(error: AssetError, folder: Path) -> ObjectAsset:
    raise error


def check_jobs(jobs: Iterable[AssetJob]) -> None:
    """Raise the error of the first job that is known to fail.

    Raises:
        AssetError: it, with its id.
    """
    for job in jobs:
        if job.error is not None:
            raise AssetError(_failed_result(job, str(job.error)).error.rstrip("."), fix=SKIP_FIX)


def make_assets(jobs: Sequence[AssetJob], out: Path, kept: Path, *, processes: int = 1) -> Iterator[AssetJobResult]:
    """Make assets into ``out/<id>``, or copy them from where earlier runs kept them; yields each as it gets done.

    A run that was interrupted goes on where it stopped, since every finished asset is kept.

    Args:
        jobs: what to make.
        out: folder of the pack.
        kept: folder where finished assets are kept.
        processes: how many to make at a time.
    """
    _delete_old_entries(kept)
    todo = []
    for job in jobs:
        place = kept / f"{job.id}-{job.content[:20]}"
        asset = _copy_from_cache(place, out / job.id)
        if asset is None:
            todo.append((job, place))
        else:
            yield AssetJobResult(job.id, asset, reused=True)
    for made, place in _run(todo, processes):
        # another run may be replacing it by the same just now
        if made.asset is None or _copy_from_cache(place, out / made.id) or _copy_from_cache(place, out / made.id):
            yield made
        else:
            yield AssetJobResult(made.id, None, f"{made.id}: what was made is gone from {place.parent}")


def content_hash(*parts: object, files: Iterable[Path] = (), packages: Sequence[str] = ()) -> str:
    """Hash of what an asset is made from: settings, source files, and the code and libraries that make it.

    Args:
        parts: settings; must have a telling ``repr``.
        files: source files; their names count too.
        packages: folders of ``asset_tools`` with further code and YAML that takes part, besides what all assets share.
    """
    digest = hashlib.sha256(repr((SCHEMA_VERSION, parts)).encode())
    for path in files:
        digest.update(f"{path.name} {sha256(path)}".encode())
    for package in ("", "quality", "readers", *packages):
        digest.update(_code(package).encode())
    return digest.hexdigest()


@cache
def _code(package: str) -> str:
    here = Path(__file__).parent
    digest = hashlib.sha256()
    for path in sorted(path for path in (here / package).iterdir() if path.suffix in (".py", ".yaml")):
        if package or not path.name.startswith(UNRELATED_FILES):
            digest.update(path.read_bytes())
    if not package:
        for path in sorted((here.parent / "robocas_ms3" / "assets").glob("*.py")):
            digest.update(path.read_bytes())
        digest.update(repr([(name, version(name)) for name in TOOLS]).encode())
    return digest.hexdigest()


def _run(todo: list[tuple[AssetJob, Path]], processes: int) -> Iterator[tuple[AssetJobResult, Path]]:
    workers = processes if min(processes, len(todo)) > 1 else 0
    with WorkerPool(partial(FunctionWorker, _make), workers, on_crash=_crashed) as pool:
        yield from pool.map(todo, ordered=False)


def _crashed(task: tuple[AssetJob, Path], why: str) -> tuple[AssetJobResult, Path]:
    job, place = task
    return AssetJobResult(job.id, None, f"{job.id}: the worker process crashed ({why})"), place


def _make(task: tuple[AssetJob, Path]) -> tuple[AssetJobResult, Path]:
    job, place = task
    start = time.perf_counter()
    try:
        with atomic_folder(place) as tmp:
            asset = job.make(tmp)
            (tmp / ENTRY).write_text(asset.model_dump_json(), encoding="utf-8")
    except RobocasError as error:
        made = _failed_result(job, str(error))
    except Exception as error:  # whatever a mesh library trips over: one asset fails, with its name, not the run
        log.debug("%s failed", job.id, exc_info=True)
        made = _failed_result(job, f"{type(error).__name__}: {' '.join(str(error).split())}")
    else:
        made = AssetJobResult(job.id, asset, seconds=time.perf_counter() - start)
    return made, place


def _failed_result(job: AssetJob, message: str) -> AssetJobResult:
    return AssetJobResult(job.id, None, message if message.startswith(job.id) else f"{job.id}: {message}")


def _copy_from_cache(place: Path, folder: Path) -> ObjectAsset | FurnitureAsset | None:
    """Copy an asset that was kept; none if there is none, or it was damaged since."""
    try:
        asset = validate_json(_ASSET, (place / ENTRY).read_bytes())
        place.touch()
        shutil.copytree(place, folder, ignore=shutil.ignore_patterns(ENTRY))
        if all(sha256(folder / name) == found for name, found in asset.files.items()):
            return asset
    except (OSError, shutil.Error, ValidationError):
        pass
    shutil.rmtree(folder, ignore_errors=True)
    return None


def _delete_old_entries(kept: Path) -> None:
    oldest = time.time() - CACHE_DAYS * 86400
    for place in kept.glob("*-*"):
        if place.stat().st_mtime < oldest:
            shutil.rmtree(place, ignore_errors=True)


def write_pack(
    jobs: Sequence[AssetJob],
    folder: Path,
    kept: Path,
    *,
    description: str = "",
    processes: int = 1,
    skip_errors: bool = False,
    record: bool = True,
    on_made: Callable[[AssetJobResult], None] = lambda made: None,
) -> list[AssetJobResult]:
    """Make a pack of assets: it appears at ``folder`` when all are done, or not at all.

    Args:
        jobs: the assets.
        folder: of the pack; its name is the pack's.
        kept: see `make_assets`.
        description: for the manifest.
        processes: how many to make at a time.
        skip_errors: leave out assets that can't be made, instead of giving up.
        record: write down what each asset was made from, for `up_to_date`.
        on_made: called after each asset.

    Raises:
        AssetError: an asset can't be made, or not be simulated as it is, naming it and why; or none can.
    """
    check_pack_folder(folder)
    results = []
    with atomic_folder(folder) as tmp:
        for made in make_assets(jobs, tmp, kept, processes=processes):
            if made.asset is None and not skip_errors:
                raise AssetError(made.error.rstrip("."), fix=SKIP_FIX)
            results.append(made)
            on_made(made)
        results = _remove_hull_violations(results, tmp, skip_errors)
        assets = sorted((made.asset for made in results if made.asset), key=lambda asset: (asset.kind, asset.id))
        if not assets:
            raise AssetError("none of the assets could be made", where=folder, found=results[0].error)
        manifest = PackManifest(name=folder.name, description=description, assets=assets)
        (tmp / MANIFEST).write_text(manifest.model_dump_json(indent=1) + "\n", encoding="utf-8")
        if record:
            bad = sorted(made.id for made in results if made.asset is None)
            write_json(tmp / MADE_FROM, {"content": {job.id: job.content for job in jobs}, "left_out": bad})
    return results


def _remove_hull_violations(results: list[AssetJobResult], folder: Path, skip_errors: bool) -> list[AssetJobResult]:
    """Give up, or leave them out, where the physics engine makes less of hulls than their files say."""
    faults: dict[str, str] = {}
    for fault in find_hull_violations(folder):
        faults.setdefault(fault.asset.partition("/")[0], str(fault))
    if faults and not skip_errors:
        raise AssetError("; ".join(faults.values()), fix=SKIP_FIX)
    for name in faults:
        shutil.rmtree(folder / name)
    return [AssetJobResult(made.id, None, faults[made.id]) if made.id in faults else made for made in results]


def check_pack_folder(folder: Path) -> None:
    """See that a pack may be written to a folder.

    Raises:
        AssetError: its name is no name for a pack.
        OutputExistsError: there is something there that is no pack.
    """
    if not re.fullmatch(PACK_NAME, folder.name):
        expected = "small letters, digits, _ and -"
        raise AssetError("this is no name for a pack", where=folder, expected=expected, found=folder.name)
    check_replaceable(folder, overwrite=True, markers=(MANIFEST,))


def is_up_to_date(jobs: Sequence[AssetJob], folder: Path, *, skip_errors: bool = False) -> bool:
    """Whether a pack was made of just these assets, by this code; with ``skip_errors``, some may have been left out."""
    try:
        found = load_json(folder / MADE_FROM)
        return found["content"] == {job.id: job.content for job in jobs} and (skip_errors or not found["left_out"])
    except (OSError, ValueError, TypeError, KeyError):
        return False
