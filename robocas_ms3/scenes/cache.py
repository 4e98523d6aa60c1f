"""The layout cache: layouts made ahead or on demand, and kept, so that a reset only sets poses."""

from __future__ import annotations

import hashlib
import json
import logging
import weakref
from collections.abc import Generator, Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, NoReturn

from sapien import physx

from robocas_ms3.assets.pack import MANIFEST, LoadedFurniture, sha256
from robocas_ms3.core.documents import DAMAGED_FILE_ERRORS
from robocas_ms3.core.errors import LayoutError, SimulationError
from robocas_ms3.core.files import make_folder, open_for_append, write_json
from robocas_ms3.core.locks import lock_file
from robocas_ms3.core.paths import cache_dir
from robocas_ms3.core.workers import FunctionWorker, WorkerPool
from robocas_ms3.scenes.layout import Layout, LayoutSource, ObjectIds, read_layout, write_layout
from robocas_ms3.scenes.layout_table import (
    Engine,
    FrozenLayouts,
    LayoutStatus,
    LayoutTable,
    SeedPair,
    write_statuses,
    write_table,
)
from robocas_ms3.scenes.model import SceneModel
from robocas_ms3.scenes.sample import sample_layout

LAYOUT_FORMAT = 14  # raised when the same seed gives another layout, or the files change
ABOUT = "about.json"  # in the folder of a cache: all that its layouts depend on
_FOLDER_SIZE = 1000  # layouts
# parts of a configuration that layouts do not depend on
_NOT_OF_LAYOUTS = {
    "description",
    "support",
    "lights",
    "robot_start",
    "language",
    "base_motion",
    "static_camera",
    "cameras",
    "room",
}
_LOOKS = {"room", "finishes", "lights", "cameras"}
_log = logging.getLogger(__name__)


def layout_source(model: SceneModel, layouts: str | Path | LayoutSource | None = "auto") -> LayoutSource:
    """Return the source of an environment's layouts.

    Args:
        model: the scene's assets.
        layouts: folder of all layout caches; ``auto``: in the user's cache folder; None: every layout is sampled again;
            a ``.npy`` file: of frozen layouts; or a source itself.
    """
    if callable(layouts):
        return layouts
    if str(layouts).endswith(".npy"):
        return FrozenLayouts(Path(str(layouts)), model.object_pack.objects)
    return LayoutSampler(model) if layouts is None else LayoutCache(model, layouts)


def caches_folder(root: str | Path = "auto") -> Path:
    """Return the folder of all layout caches; ``auto``: in the user's cache folder."""
    return cache_dir() / "layouts" if root == "auto" else Path(root)


class LayoutSampler:
    """Samples layouts, the same ones in every process.

    Where PhysX has a GPU it cooks hulls otherwise, on a CPU too, and heaps come to rest elsewhere. There a worker
    process samples the layouts; it ends with this object.
    """

    def __init__(self, model: SceneModel) -> None:
        self._model = model
        self._pool: WorkerPool[tuple[int, int, ObjectIds | None], Layout] | None = None
        self._object_ids: dict[int, ObjectIds] = {}

    def __call__(self, objects_seed: int, seed: int) -> Layout:
        if objects_seed == seed:
            return self.make(seed, seed)
        if objects_seed not in self._object_ids:
            self._object_ids[objects_seed] = self.make(objects_seed, objects_seed).object_ids
        return self.make(objects_seed, seed, self._object_ids[objects_seed])

    def make(self, objects_seed: int, seed: int, object_ids: ObjectIds | None = None) -> Layout:
        """Return the layout of two seeds, with the objects of the objects seed if the seeds differ.

        Raises:
            LayoutError: there is no layout.
            SimulationError: the worker process died, and another one too.
        """
        if not physx.is_gpu_enabled():
            return sample_layout(self._model, objects_seed, seed, object_ids)
        if self._pool is None:
            make_worker = partial(FunctionWorker, partial(_sample, self._model))
            self._pool = WorkerPool(make_worker, 1, on_crash=_raise_crash)
            weakref.finalize(self, self._pool.stop)
        return self._pool.run((objects_seed, seed, object_ids))

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_pool": None}


def _sample(model: SceneModel, task: tuple[int, int, ObjectIds | None]) -> Layout:
    return sample_layout(model, *task)


def _raise_crash(task: tuple[int, int, ObjectIds | None], reason: str) -> NoReturn:
    # not a `LayoutError`: another seed would not help
    raise SimulationError("the process that samples layouts died", where=f"seed {task[1]}", found=reason)


class LayoutCache:
    """Layouts of one configuration and its packs, a small file each; a `LayoutSource`.

    Several processes may use a cache at once: files appear whole, and two that make the same layout make the same file.

    Args:
        model: the scene's assets.
        root: of all caches; see `caches_folder`.

    Attributes:
        folder: of this cache.
    """

    def __init__(self, model: SceneModel, root: str | Path = "auto") -> None:
        self.model = model
        self._sample = LayoutSampler(model)
        self._names = sorted(model.object_pack.objects)
        self._about = _about(model)
        key = hashlib.sha256(json.dumps(self._about, sort_keys=True).encode()).hexdigest()[:16]
        self.folder = caches_folder(root) / f"{model.config.task}-{key}"

    def table(self, engine: Engine) -> LayoutTable | None:
        """Return its layouts as one mapped file, if that was written for an engine and is not damaged."""
        path = self.table_path(engine)
        if not path.is_file():
            return None
        try:
            return LayoutTable(path, self._names)
        except LayoutError as error:
            _log.warning("%s", error)
            return None

    def table_path(self, engine: Engine) -> Path:
        return self.folder / f"table-{engine}.npy"

    def write_table(self, engine: Engine, pairs: Iterable[SeedPair]) -> LayoutTable | None:
        """Write the layouts that exist of some pairs as a table, if any does; an earlier table's layouts stay in it."""
        with self._locked():
            before = self.table(engine)
            states = {pair: before.state(pair) for pair in before.pairs()} if before else {}
            layouts: dict[SeedPair, Layout] = {}
            for pair in dict.fromkeys([*states, *pairs]):
                if self.path(*pair).is_file():
                    layouts[pair] = self.get(*pair)
                elif before is not None and (tabled := before.layout(pair)) is not None:
                    layouts[pair] = tabled
            if layouts:
                write_table(self.table_path(engine), self._names, layouts, states)
            return self.table(engine)

    def write_statuses(self, engine: Engine, states: Mapping[SeedPair, LayoutStatus]) -> None:
        with self._locked():
            write_statuses(self.table_path(engine), self._names, states)

    @contextmanager
    def _locked(self) -> Iterator[None]:
        with open_for_append(make_folder(self.folder) / ".tables.lock") as file:
            lock_file(file, self.folder, wait=True)
            yield

    def path(self, objects_seed: int, seed: int) -> Path:
        name = f"{seed:010d}" if seed == objects_seed else f"{seed:010d}-of-{objects_seed:010d}"
        return self.folder / f"{seed // _FOLDER_SIZE:07d}" / f"{name}.npz"

    def get(self, objects_seed: int, seed: int) -> Layout:
        """Return the layout of two seeds (see `sample_layout`), from its file if there is one, else made and kept.

        Raises:
            LayoutError: there is no layout. Nothing is kept of that.
        """
        path = self.path(objects_seed, seed)
        if path.is_file():
            try:
                layout = read_layout(path)
                layout.check(self._names)
                return layout
            except (*DAMAGED_FILE_ERRORS, KeyError, TypeError) as error:
                _log.warning("%s: damaged, made again (%s)", path, error)
        known = None if objects_seed == seed else self.get(objects_seed, objects_seed).object_ids
        layout = self._sample.make(objects_seed, seed, known)
        if not (self.folder / ABOUT).is_file():
            make_folder(self.folder)
            write_json(self.folder / ABOUT, self._about)
        make_folder(path.parent)
        write_layout(layout, path)
        return layout

    __call__ = get

    def missing(self, pairs: Iterable[SeedPair]) -> list[SeedPair]:
        return [pair for pair in pairs if not self.path(*pair).is_file()]

    def fill(self, pairs: Iterable[SeedPair], jobs: int = 1) -> Generator[tuple[SeedPair, str], None, None]:
        """Make the layouts that are missing. Objects' own layouts come first, with which the others begin.

        Args:
            pairs: of seeds.
            jobs: processes; the outcome does not depend on it.

        Yields:
            Each pair when it is done, in any order, and why there is no layout; empty where there is one.
        """
        missing = self.missing(pairs)
        without: dict[int, str] = {}  # objects seeds without objects, and why
        workers = jobs if min(jobs, len(missing)) > 1 else 0
        with WorkerPool(partial(FunctionWorker, partial(_make, self)), workers, on_crash=_crashed) as pool:
            for pair, problem in pool.map((pair for pair in missing if pair[0] == pair[1]), ordered=False):
                if problem:
                    without[pair[0]] = problem
                yield pair, problem
            others = [pair for pair in missing if pair[0] != pair[1]]
            yield from ((pair, without[pair[0]]) for pair in others if pair[0] in without)
            yield from pool.map((pair for pair in others if pair[0] not in without), ordered=False)


def _make(cache: LayoutCache, pair: SeedPair) -> tuple[SeedPair, str]:
    try:
        cache.get(*pair)
    except LayoutError as error:
        return pair, str(error)
    return pair, ""


def _crashed(pair: SeedPair, why: str) -> tuple[SeedPair, str]:
    return pair, f"the process that made it died ({why}); is memory short?"


def seed_pairs(seeds: Iterable[int], objects: Iterable[int] | None = None) -> list[SeedPair]:
    """Return the pairs of seeds whose layouts environments ask for.

    Args:
        seeds: of layouts.
        objects: seeds of objects, as several envs have them: each goes with all ``seeds``, and first with itself, which
            is the layout its env is built with. None: as one env has it, objects and layout of one seed.
    """
    if objects is None:
        return [(seed, seed) for seed in seeds]
    seeds = list(seeds)
    return [(chosen, seed) for chosen in objects for seed in dict.fromkeys([chosen, *seeds])]


def count_layouts(folder: Path) -> int:
    return sum(1 for path in folder.glob("*/*.npz") if not path.name.startswith("."))


def _about(model: SceneModel) -> dict[str, Any]:
    config = model.config.model_dump(mode="json", exclude=_NOT_OF_LAYOUTS)
    config["randomisation"] = {k: v for k, v in config["randomisation"].items() if k not in _LOOKS}
    parts: dict[str, LoadedFurniture] = {**model.furniture, **({"basket": model.basket} if model.basket else {})}
    return {
        "layout_format": LAYOUT_FORMAT,
        "config": config,
        "object_pack": {"name": model.object_pack.name, "manifest": sha256(model.object_pack.root / MANIFEST)},
        "furniture": {name: part.asset.model_dump(mode="json", exclude={"quality"}) for name, part in parts.items()},
        "versions": {name: version(name) for name in ("sapien", "numpy", "scipy", "shapely", "trimesh", "embreex")},
    }
