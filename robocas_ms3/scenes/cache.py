"""The layout cache: layouts are sampled in advance or at the first use, and stored in files."""

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

LAYOUT_FORMAT = 14  # increased when a seed gives another layout or when the files change
ABOUT = "about.json"  # file of a cache folder that lists everything the layouts depend on
_FOLDER_SIZE = 1000  # layouts
# keys of a configuration that have no effect on layouts
_KEYS_WITHOUT_EFFECT = {
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
_APPEARANCE_KEYS = {"room", "finishes", "lights", "cameras"}
_log = logging.getLogger(__name__)


def make_layout_source(model: SceneModel, layouts: str | Path | LayoutSource | None = "auto") -> LayoutSource:
    """Return the source from which an environment gets its layouts.

    Args:
        model: configuration and assets.
        layouts: ``auto`` or the folder of all layout caches: a `LayoutCache` in it (``auto``: in the cache folder of
            the user). None: a `LayoutSampler`, without a cache. Path of a ``.npy`` file: `FrozenLayouts`. A
            `LayoutSource` is returned unchanged.
    """
    if callable(layouts):
        return layouts
    if str(layouts).endswith(".npy"):
        return FrozenLayouts(Path(str(layouts)), model.object_pack.objects)
    return LayoutSampler(model) if layouts is None else LayoutCache(model, layouts)


def layout_caches_folder(root: str | Path = "auto") -> Path:
    """Return the folder of all layout caches.

    Args:
        root: the folder; ``auto``: ``layouts`` in the cache folder of the user.
    """
    return cache_dir() / "layouts" if root == "auto" else Path(root)


class LayoutSampler:
    """A `LayoutSource` that samples each layout when it is needed, and stores none.

    In a process that uses PhysX on a GPU, collision hulls differ, so heaps would settle in other poses. Such a process
    therefore samples layouts in a worker process, which ends when this object is deleted.
    """

    def __init__(self, model: SceneModel) -> None:
        self._model = model
        self._pool: WorkerPool[tuple[int, int, ObjectIds | None], Layout] | None = None
        self._object_ids: dict[int, ObjectIds] = {}

    def __call__(self, objects_seed: int, seed: int) -> Layout:
        if objects_seed == seed:
            return self.sample(seed, seed)
        if objects_seed not in self._object_ids:
            self._object_ids[objects_seed] = self.sample(objects_seed, objects_seed).object_ids
        return self.sample(objects_seed, seed, self._object_ids[objects_seed])

    def sample(self, objects_seed: int, seed: int, object_ids: ObjectIds | None = None) -> Layout:
        """Sample the layout of an objects seed and a seed.

        Args:
            objects_seed: decides the objects.
            seed: decides everything else.
            object_ids: objects of ``objects_seed``; None: the sampler draws them.

        Raises:
            LayoutError: the seeds have no layout.
            SimulationError: the worker process crashed twice.
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
    fix = "Free some memory and try again."
    raise SimulationError("the process that samples layouts crashed", where=f"seed {task[1]}", found=reason, fix=fix)


class LayoutCache:
    """A `LayoutSource` that stores the layouts of one configuration in a folder, one file per layout.

    Several processes may use a cache at the same time: files are written atomically, and equal seeds give equal files.

    Args:
        model: configuration and assets.
        root: folder of all caches, or ``auto`` (see `layout_caches_folder`).

    Attributes:
        folder: folder of this cache.
    """

    def __init__(self, model: SceneModel, root: str | Path = "auto") -> None:
        self.model = model
        self._sample = LayoutSampler(model)
        self._names = sorted(model.object_pack.objects)
        self._about = _describe_inputs(model)
        key = hashlib.sha256(json.dumps(self._about, sort_keys=True).encode()).hexdigest()[:16]
        self.folder = layout_caches_folder(root) / f"{model.config.task}-{key}"

    def load_table(self, engine: Engine) -> LayoutTable | None:
        """Load the layout table of an engine, mapped into memory.

        Return None if the file is missing or damaged.
        """
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
        """Write the stored layouts of seed pairs to the table of an engine, and return the table.

        The table keeps the layouts that it already has. If there is no layout at all, no table is written, and the
        result is None.
        """
        with self._locked():
            before = self.load_table(engine)
            statuses = {pair: before.status(pair) for pair in before.find_pairs()} if before else {}
            layouts: dict[SeedPair, Layout] = {}
            for pair in dict.fromkeys([*statuses, *pairs]):
                if self.layout_path(*pair).is_file():
                    layouts[pair] = self.get(*pair)
                elif before is not None and (tabled := before.layout(pair)) is not None:
                    layouts[pair] = tabled
            if layouts:
                write_table(self.table_path(engine), self._names, layouts, statuses)
            return self.load_table(engine)

    def write_statuses(self, engine: Engine, statuses: Mapping[SeedPair, LayoutStatus]) -> None:
        with self._locked():
            write_statuses(self.table_path(engine), self._names, statuses)

    @contextmanager
    def _locked(self) -> Iterator[None]:
        with open_for_append(make_folder(self.folder) / ".tables.lock") as file:
            lock_file(file, self.folder, wait=True)
            yield

    def layout_path(self, objects_seed: int, seed: int) -> Path:
        name = f"{seed:010d}" if seed == objects_seed else f"{seed:010d}-of-{objects_seed:010d}"
        return self.folder / f"{seed // _FOLDER_SIZE:07d}" / f"{name}.npz"

    def get(self, objects_seed: int, seed: int) -> Layout:
        """Return the layout of an objects seed and a seed.

        If the layout has no file yet, sample and store it.

        Raises:
            LayoutError: the seeds have no layout; this result is not stored.
        """
        path = self.layout_path(objects_seed, seed)
        if path.is_file():
            try:
                layout = read_layout(path)
                layout.check(self._names)
                return layout
            except (*DAMAGED_FILE_ERRORS, KeyError, TypeError) as error:
                _log.warning("%s: damaged layout file, the layout is sampled again (%s)", path, error)
        known = None if objects_seed == seed else self.get(objects_seed, objects_seed).object_ids
        layout = self._sample.sample(objects_seed, seed, known)
        if not (self.folder / ABOUT).is_file():
            make_folder(self.folder)
            write_json(self.folder / ABOUT, self._about)
        make_folder(path.parent)
        write_layout(layout, path)
        return layout

    __call__ = get

    def missing_pairs(self, pairs: Iterable[SeedPair]) -> list[SeedPair]:
        return [pair for pair in pairs if not self.layout_path(*pair).is_file()]

    def fill(self, pairs: Iterable[SeedPair], jobs: int = 1) -> Generator[tuple[SeedPair, str], None, None]:
        """Sample and store the layouts of those seed pairs that have no file yet.

        Pairs of equal seeds come first, because they decide the objects of the other pairs.

        Args:
            pairs: pairs (objects seed, seed).
            jobs: number of processes, which has no effect on the layouts.

        Yields:
            Each finished pair, in any order, and the reason why it has no layout; the reason is empty on success.
        """
        missing = self.missing_pairs(pairs)
        without: dict[int, str] = {}  # objects seeds without objects, and why
        workers = jobs if min(jobs, len(missing)) > 1 else 0
        with WorkerPool(
            partial(FunctionWorker, partial(_store_layout, self)), workers, on_crash=_describe_crash
        ) as pool:
            for pair, problem in pool.map((pair for pair in missing if pair[0] == pair[1]), ordered=False):
                if problem:
                    without[pair[0]] = problem
                yield pair, problem
            others = [pair for pair in missing if pair[0] != pair[1]]
            yield from ((pair, without[pair[0]]) for pair in others if pair[0] in without)
            yield from pool.map((pair for pair in others if pair[0] not in without), ordered=False)


def _store_layout(cache: LayoutCache, pair: SeedPair) -> tuple[SeedPair, str]:
    try:
        cache.get(*pair)
    except LayoutError as error:
        return pair, str(error)
    return pair, ""


def _describe_crash(pair: SeedPair, why: str) -> tuple[SeedPair, str]:
    return pair, f"the process that sampled the layout crashed ({why}); check the available memory"


def seed_pairs(seeds: Iterable[int], objects: Iterable[int] | None = None) -> list[SeedPair]:
    """Return the pairs (objects seed, seed) of the layouts that environments need.

    Args:
        seeds: seeds of the layouts.
        objects: objects seed of each env of a vector environment. The result has each objects seed S with all
            ``seeds``, and the pair (S, S), with which the env is built. None: a single env, which needs (S, S) for
            each S of ``seeds``.
    """
    if objects is None:
        return [(seed, seed) for seed in seeds]
    seeds = list(seeds)
    return [(chosen, seed) for chosen in objects for seed in dict.fromkeys([chosen, *seeds])]


def count_layouts(folder: Path) -> int:
    return sum(1 for path in folder.glob("*/*.npz") if not path.name.startswith("."))


def _describe_inputs(model: SceneModel) -> dict[str, Any]:
    config = model.config.model_dump(mode="json", exclude=_KEYS_WITHOUT_EFFECT)
    config["randomisation"] = {k: v for k, v in config["randomisation"].items() if k not in _APPEARANCE_KEYS}
    parts: dict[str, LoadedFurniture] = {**model.furniture, **({"basket": model.basket} if model.basket else {})}
    return {
        "layout_format": LAYOUT_FORMAT,
        "config": config,
        "object_pack": {"name": model.object_pack.name, "manifest": sha256(model.object_pack.root / MANIFEST)},
        "furniture": {name: part.asset.model_dump(mode="json", exclude={"quality"}) for name, part in parts.items()},
        "versions": {name: version(name) for name in ("sapien", "numpy", "scipy", "shapely", "trimesh", "embreex")},
    }
