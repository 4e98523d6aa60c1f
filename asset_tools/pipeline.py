"""Making many assets: in parallel, each kept by the content it was made from, so that what is done is never redone."""

from __future__ import annotations

import hashlib
import json
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from multiprocessing import get_context
from pathlib import Path

from pydantic import TypeAdapter, ValidationError
from scipy.spatial import QhullError

from robocas_ms3.assets.manifest import SCHEMA_VERSION, Asset, FurnitureAsset, ObjectAsset, PackManifest
from robocas_ms3.assets.pack import MANIFEST, sha256
from robocas_ms3.errors import AssetError, RobocasError
from robocas_ms3.files import replacing_folder, write_json

MADE_FROM = "made_from.json"  # of a pack: asset id -> hash of what it was made from
ENTRY = "asset.json"  # what the manifest says of a kept asset; written last
KEPT_DAYS = 60  # an asset that wasn't asked for in this time is made again
TOOLS = ("coacd", "trimesh", "manifold3d", "numpy", "scipy", "sapien", "xatlas", "fast-simplification", "embreex")
NOT_INVOLVED = ("pipeline", "sheet", "studio", "import_")  # files that say what is made or show it, not how it is made

_ASSET: TypeAdapter[ObjectAsset | FurnitureAsset] = TypeAdapter(Asset)


@dataclass(frozen=True)
class Job:
    """An asset to make.

    Attributes:
        id: of the asset.
        make: makes its files in a folder and says what the manifest says of it; must survive pickling.
        content: hash of everything the asset depends on besides this code, see `content_hash`.
    """

    id: str
    make: Callable[[Path], ObjectAsset | FurnitureAsset]
    content: str


@dataclass(frozen=True)
class Made:
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


def make_assets(jobs: Sequence[Job], out: Path, kept: Path, *, processes: int = 1) -> Iterator[Made]:
    """Make assets into ``out/<id>``, or copy them from where earlier runs kept them; yields each as it gets done.

    A run that was interrupted goes on where it stopped, since every finished asset is kept.

    Args:
        jobs: what to make.
        out: folder of the pack.
        kept: folder where finished assets are kept.
        processes: how many to make at a time.
    """
    _forget_old(kept)
    todo = []
    for job in jobs:
        place = kept / f"{job.id}-{job.content[:20]}"
        asset = _kept_asset(place)
        if asset is None:
            todo.append((job, place))
        else:
            place.touch()
            shutil.copytree(place, out / job.id, ignore=shutil.ignore_patterns(ENTRY))
            yield Made(job.id, asset, reused=True)
    for made, place in _run(todo, processes):
        if made.asset is not None:
            shutil.copytree(place, out / made.id, ignore=shutil.ignore_patterns(ENTRY))
        yield made


def content_hash(*parts: object, files: Iterable[Path] = (), packages: Sequence[str] = ()) -> str:
    """Hash of what an asset is made from: settings, source files, and the code and libraries that make it.

    Args:
        parts: settings; must have a telling ``repr``.
        files: source files; their names count too.
        packages: folders of ``asset_tools`` with further code that takes part, besides what all assets share.
    """
    digest = hashlib.sha256(repr((SCHEMA_VERSION, parts)).encode())
    for path in files:
        digest.update(f"{path.name} {sha256(path)}".encode())
    for package in ("", "quality", *packages):
        digest.update(_code(package).encode())
    return digest.hexdigest()


@cache
def _code(package: str) -> str:
    here = Path(__file__).parent
    digest = hashlib.sha256()
    for path in sorted((here / package).glob("*.py")):
        if package or not path.name.startswith(NOT_INVOLVED):
            digest.update(path.read_bytes())
    if not package:
        for path in sorted((here.parent / "robocas_ms3" / "assets").glob("*.py")):
            digest.update(path.read_bytes())
        digest.update(repr([(name, version(name)) for name in TOOLS]).encode())
    return digest.hexdigest()


def _run(todo: list[tuple[Job, Path]], processes: int) -> Iterator[tuple[Made, Path]]:
    if processes <= 1 or len(todo) <= 1:
        yield from ((_make(job, place), place) for job, place in todo)
        return
    # physics and rendering libraries don't survive a fork
    with ProcessPoolExecutor(min(processes, len(todo)), mp_context=get_context("spawn")) as pool:
        futures: dict[Future[Made], Path] = {pool.submit(_make, job, place): place for job, place in todo}
        try:
            for future in as_completed(futures):
                yield future.result(), futures[future]
        finally:
            pool.shutdown(cancel_futures=True)


def _make(job: Job, place: Path) -> Made:
    start = time.perf_counter()
    try:
        with replacing_folder(place) as tmp:
            asset = job.make(tmp)
            (tmp / ENTRY).write_text(asset.model_dump_json(), encoding="utf-8")
    except (RobocasError, QhullError) as error:
        message = "it is flat, or has too few points" if isinstance(error, QhullError) else str(error)
        return Made(job.id, None, message if job.id in message else f"{job.id}: {message}")
    return Made(job.id, asset, seconds=time.perf_counter() - start)


def _kept_asset(place: Path) -> ObjectAsset | FurnitureAsset | None:
    """What was kept, unless there is nothing or it was damaged since."""
    try:
        asset = _ASSET.validate_json((place / ENTRY).read_bytes())
    except (OSError, ValidationError):
        return None
    whole = all((place / name).is_file() and sha256(place / name) == found for name, found in asset.files.items())
    return asset if whole else None


def _forget_old(kept: Path) -> None:
    oldest = time.time() - KEPT_DAYS * 86400
    for place in kept.glob("*-*"):
        if place.stat().st_mtime < oldest:
            shutil.rmtree(place, ignore_errors=True)


def write_pack(
    jobs: Sequence[Job],
    folder: Path,
    kept: Path,
    *,
    description: str = "",
    processes: int = 1,
    skip_bad: bool = False,
    record: bool = True,
    on_made: Callable[[Made], None] = lambda made: None,
) -> list[Made]:
    """Make a pack of assets: it appears at ``folder`` when all are done, or not at all.

    Args:
        jobs: the assets.
        folder: of the pack; its name is the pack's.
        kept: see `make_assets`.
        description: for the manifest.
        processes: how many to make at a time.
        skip_bad: leave out assets that can't be made, instead of giving up.
        record: write down what each asset was made from, for `up_to_date`.
        on_made: called after each asset.

    Raises:
        AssetError: an asset can't be made, naming it and why; or none can.
    """
    results = []
    with replacing_folder(folder) as tmp:
        for made in make_assets(jobs, tmp, kept, processes=processes):
            if made.asset is None and not skip_bad:
                raise AssetError(made.error, fix="Mend it, or pass --skip-bad to leave it out.")
            results.append(made)
            on_made(made)
        assets = sorted((made.asset for made in results if made.asset), key=lambda asset: (asset.kind, asset.id))
        if not assets:
            raise AssetError("none of the assets could be made", where=folder)
        manifest = PackManifest(name=folder.name, description=description, assets=assets)
        (tmp / MANIFEST).write_text(manifest.model_dump_json(indent=1) + "\n", encoding="utf-8")
        if record:
            write_json(tmp / MADE_FROM, {job.id: job.content for job in jobs})
    return results


def up_to_date(jobs: Sequence[Job], folder: Path) -> bool:
    """Whether a pack was made of just these assets, by this code."""
    try:
        found = json.loads((folder / MADE_FROM).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return found == {job.id: job.content for job in jobs}
