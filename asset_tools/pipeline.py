"""Build packs of assets in parallel, with a cache of finished assets by a hash of their inputs."""

from __future__ import annotations

import hashlib
import logging
import re
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache as cached
from functools import partial
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
from robocas_ms3.core.text import format_count
from robocas_ms3.core.workers import FunctionWorker, WorkerPool

MADE_FROM = "made_from.json"  # file of a pack: asset id -> hash of its inputs
ENTRY = "asset.json"  # manifest entry of a cached asset; written last
CACHE_DAYS = 60  # a cached asset that was not used in this time is deleted
TOOLS = ("coacd", "trimesh", "manifold3d", "numpy", "scipy", "sapien", "xatlas", "fast-simplification", "embreex") + (
    "pillow",
    "scikit-image",
    "shapely",
)
SKIP_FIX = "Pass --skip-errors to skip it."
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
    """An asset to build.

    Attributes:
        id: id of the asset.
        make: writes the files of the asset to a folder and returns its manifest entry; must be picklable.
        content: hash of all inputs of the asset, see `compute_content_hash`.
        error: error that was found before the build, or None.
    """

    id: str
    make: Callable[[Path], ObjectAsset | FurnitureAsset]
    content: str
    error: AssetError | None = None

    def __post_init__(self) -> None:
        check_asset_name(self.id, "an asset's id")


@dataclass(frozen=True)
class AssetJobResult:
    """Result of a job.

    Attributes:
        id: id of the asset.
        asset: manifest entry of the asset; None if the job failed.
        error: reason of the failure; empty if the job succeeded.
        reused: whether the asset was copied from the cache.
        seconds: duration of the build; 0 for a copy from the cache.
    """

    id: str
    asset: ObjectAsset | FurnitureAsset | None
    error: str = ""
    reused: bool = False
    seconds: float = 0.0


def make_failing_job(id_: str, error: AssetError) -> AssetJob:
    """Return a job that raises ``error`` when it runs, so that ``skip_errors`` can skip the asset."""
    return AssetJob(id_, partial(_fail, error), compute_content_hash(str(error)), error)


def _fail(error: AssetError, folder: Path) -> ObjectAsset:
    raise error


def check_jobs(jobs: Iterable[AssetJob]) -> None:
    """Raise AssetError for the first job whose ``error`` was found before the build."""
    for job in jobs:
        if job.error is not None:
            raise AssetError(_failed_result(job, str(job.error)).error.rstrip("."), fix=SKIP_FIX)


def build_assets(jobs: Sequence[AssetJob], out: Path, cache: Path, *, processes: int = 1) -> Iterator[AssetJobResult]:
    """Build assets in ``out/<id>``, or copy them from the cache.

    Yield each result as soon as it is available.

    An interrupted run continues where it stopped, since every finished asset is cached.

    Args:
        jobs: assets to build.
        out: existing folder of the pack.
        cache: folder of the cache, which is created if it is missing.
        processes: number of worker processes.
    """
    _delete_old_entries(cache)
    todo = []
    for job in jobs:
        place = cache / f"{job.id}-{job.content[:20]}"
        asset = _copy_from_cache(place, out / job.id)
        if asset is None:
            todo.append((job, place))
        else:
            yield AssetJobResult(job.id, asset, reused=True)
    for made, place in _run(todo, processes):
        # a second try: another run may replace the entry by an identical one at the same time
        if made.asset is None or _copy_from_cache(place, out / made.id) or _copy_from_cache(place, out / made.id):
            yield made
        else:
            message = f"{made.id}: another process removed the finished asset from the cache {place.parent}"
            yield AssetJobResult(made.id, None, message)


def compute_content_hash(*settings: object, files: Iterable[Path] = (), packages: Sequence[str] = ()) -> str:
    """Return the SHA-256 of the inputs of an asset: settings, files, code and versions of libraries.

    Args:
        settings: values that affect the asset; each ``repr`` must contain the complete value.
        files: source files; the hash depends on their names and contents.
        packages: subfolders of ``asset_tools`` with code and YAML that affect the asset; shared code is always hashed.
    """
    digest = hashlib.sha256(repr((SCHEMA_VERSION, settings)).encode())
    for path in files:
        digest.update(f"{path.name} {sha256(path)}".encode())
    for package in ("", "quality", "readers", *packages):
        digest.update(_code(package).encode())
    return digest.hexdigest()


@cached
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
    except Exception as error:  # mesh libraries may raise any error; only this asset fails
        log.debug("%s failed", job.id, exc_info=True)
        made = _failed_result(job, f"{type(error).__name__}: {' '.join(str(error).split())}")
    else:
        made = AssetJobResult(job.id, asset, seconds=time.perf_counter() - start)
    return made, place


def _failed_result(job: AssetJob, message: str) -> AssetJobResult:
    return AssetJobResult(job.id, None, message if message.startswith(job.id) else f"{job.id}: {message}")


def _copy_from_cache(place: Path, folder: Path) -> ObjectAsset | FurnitureAsset | None:
    """Copy an asset from the cache and return its manifest entry.

    Return None if the cached asset is missing or damaged.

    Args:
        place: folder of the asset in the cache.
        folder: new folder of the asset in the pack.
    """
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


def _delete_old_entries(cache: Path) -> None:
    oldest = time.time() - CACHE_DAYS * 86400
    for place in cache.glob("*-*"):
        if place.stat().st_mtime < oldest:
            shutil.rmtree(place, ignore_errors=True)


def write_pack(
    jobs: Sequence[AssetJob],
    folder: Path,
    cache: Path,
    *,
    description: str = "",
    processes: int = 1,
    skip_errors: bool = False,
    record: bool = True,
    on_made: Callable[[AssetJobResult], None] = lambda made: None,
) -> list[AssetJobResult]:
    """Build a pack of assets; the folder is created or replaced in one step when all assets are complete.

    Args:
        jobs: assets to build.
        folder: folder of the pack; the name of the folder is the name of the pack.
        cache: folder of finished assets, see `build_assets`.
        description: description in the manifest.
        processes: number of worker processes.
        skip_errors: whether to leave out assets with errors instead of raising.
        record: whether to store the hashes of the inputs, which `is_up_to_date` compares.
        on_made: called with the result of each asset.

    Returns:
        One result per job.

    Raises:
        AssetError: an asset cannot be built or simulated, or all assets failed.
    """
    check_pack_folder(folder)
    results = []
    with atomic_folder(folder) as tmp:
        for made in build_assets(jobs, tmp, cache, processes=processes):
            if made.asset is None and not skip_errors:
                raise AssetError(made.error.rstrip("."), fix=SKIP_FIX)
            results.append(made)
            on_made(made)
        results = _remove_hull_violations(results, tmp, skip_errors)
        assets = sorted((made.asset for made in results if made.asset), key=lambda asset: (asset.kind, asset.id))
        if not assets:
            found = f"{format_count(len(results), 'error')}; the first: {results[0].error}"
            raise AssetError("no asset could be built", where=folder, expected="at least one asset", found=found)
        manifest = PackManifest(name=folder.name, description=description, assets=assets)
        (tmp / MANIFEST).write_text(manifest.model_dump_json(indent=1) + "\n", encoding="utf-8")
        if record:
            bad = sorted(made.id for made in results if made.asset is None)
            write_json(tmp / MADE_FROM, {"content": {job.id: job.content for job in jobs}, "skipped": bad})
    return results


def _remove_hull_violations(results: list[AssetJobResult], folder: Path, skip_errors: bool) -> list[AssetJobResult]:
    """Remove assets with hulls that PhysX shrinks or rejects from the pack.

    Without ``skip_errors``, raise AssetError.

    Returns:
        ``results``, with failures in place of the removed assets.
    """
    violations: dict[str, str] = {}
    for violation in find_hull_violations(folder):
        violations.setdefault(violation.asset.partition("/")[0], str(violation))
    if violations and not skip_errors:
        raise AssetError("; ".join(violations.values()), fix=SKIP_FIX)
    for name in violations:
        shutil.rmtree(folder / name)
    return [AssetJobResult(made.id, None, violations[made.id]) if made.id in violations else made for made in results]


def check_pack_folder(folder: Path) -> None:
    """Check that a pack may be written to a folder.

    Raises:
        AssetError: the folder's name is not valid for a pack.
        OutputExistsError: the path exists and is not a pack.
    """
    if not re.fullmatch(PACK_NAME, folder.name):
        expected = "lower-case letters, digits, _ and -"
        raise AssetError("invalid name of a pack", where=folder, expected=expected, found=folder.name, usage=True)
    check_replaceable(folder, overwrite=True, markers=(MANIFEST,))


def is_up_to_date(jobs: Sequence[AssetJob], folder: Path, *, skip_errors: bool = False) -> bool:
    """Return whether a pack was built from the inputs of ``jobs``.

    Args:
        jobs: jobs of all assets.
        folder: folder of the pack.
        skip_errors: whether a pack without the assets that failed also counts as up to date.
    """
    try:
        found = load_json(folder / MADE_FROM)
        return found["content"] == {job.id: job.content for job in jobs} and (skip_errors or not found["skipped"])
    except (OSError, ValueError, TypeError, KeyError):
        return False
