"""The layout bank: layouts made ahead or on demand, and kept, so that a reset only sets poses."""

from __future__ import annotations

import hashlib
import json
import logging
import multiprocessing
import zipfile
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import fields
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from sapien import physx

from robocas_ms3.assets.pack import MANIFEST, LoadedFurniture, sha256
from robocas_ms3.errors import LayoutError
from robocas_ms3.files import make_folder, replacing, write_json
from robocas_ms3.paths import cache_dir
from robocas_ms3.scenes.elsewhere import OtherProcess
from robocas_ms3.scenes.layout import Layout
from robocas_ms3.scenes.model import SceneModel
from robocas_ms3.scenes.sample import sample_layout
from robocas_ms3.scenes.table import TABLE, LayoutTable, write_table

LAYOUT_FORMAT = 13  # raised when the same seed gives another layout, or the files change
ABOUT = "about.json"  # in the folder of a bank: all that its layouts depend on
_A_FOLDER = 1000  # layouts in one
_NO_MATTER = (
    "description",
    "support",
    "lights",
    "language",
    "base_motion",
    "static_camera",
)  # parts of a configuration
_log = logging.getLogger(__name__)

Pair = tuple[int, int]
"""Objects seed, seed."""

LayoutSource = Callable[[int, int], Layout]
"""(objects seed, seed) -> layout."""


def layout_bank(model: SceneModel, folder: str | Path | None = "auto") -> LayoutSource:
    """Where an environment gets its layouts from.

    Args:
        model: the scene's assets.
        folder: of all banks; ``auto``: in the cache; None: no bank, every layout is sampled anew.
    """
    return Sampler(model) if folder is None else LayoutBank(model, folder)


class Sampler:
    """Makes layouts anew, the same ones in every process.

    Where PhysX has a GPU it cooks hulls otherwise, on a CPU too, and heaps come to rest elsewhere. So such a process
    has another one make them.

    Args:
        model: the scene's assets.
    """

    def __init__(self, model: SceneModel) -> None:
        self._model = model
        self._elsewhere: OtherProcess | None = None

    def __call__(self, objects_seed: int, seed: int) -> Layout:
        """The layout of two seeds; see `sample_layout`."""
        if not physx.is_gpu_enabled():
            return sample_layout(self._model, objects_seed, seed)
        if self._elsewhere is None:
            self._elsewhere = OtherProcess(self._model)
        return self._elsewhere.layout(objects_seed, seed)

    def __getstate__(self) -> dict[str, Any]:
        """Without the other process."""
        return {**self.__dict__, "_elsewhere": None}


def banks_folder(root: str | Path = "auto") -> Path:
    """Folder of all banks; ``auto``: in the cache."""
    return cache_dir() / "layouts" if root == "auto" else Path(root)


class LayoutBank:
    """Layouts of one configuration and its packs, one small file each.

    Several processes may use a bank at once: files appear whole, and two that make the same layout make the same file.

    Args:
        model: the scene's assets.
        root: of all banks; ``auto``: in the cache.
    """

    def __init__(self, model: SceneModel, root: str | Path = "auto") -> None:
        self.model = model
        self._sample = Sampler(model)
        self._about = about(model)
        key = hashlib.sha256(json.dumps(self._about, sort_keys=True).encode()).hexdigest()[:16]
        self.folder = banks_folder(root) / f"{model.config.task}-{key}"

    @property
    def table(self) -> LayoutTable | None:
        """Its layouts as one mapped file, if that was written; a damaged one is none."""
        path = self.folder / TABLE
        if not path.is_file():
            return None
        try:
            return LayoutTable(path)
        except LayoutError as error:
            _log.warning("%s", error)
            return None

    def write_table(self, pairs: Iterable[Pair]) -> Path:
        """Write those layouts of some pairs of seeds that are there as one file (`LayoutTable`), if any is.

        What an earlier file holds stays in it.
        """
        before = self.table
        pairs = dict.fromkeys([*(before.pairs if before else []), *pairs])
        there = {pair: read_layout(self.path(*pair)) for pair in pairs if self.path(*pair).is_file()}
        if there:
            write_table(self.folder / TABLE, there)
        return self.folder / TABLE

    def path(self, objects_seed: int, seed: int) -> Path:
        """File of a layout."""
        name = f"{seed:010d}" if seed == objects_seed else f"{seed:010d}-of-{objects_seed:010d}"
        return self.folder / f"{seed // _A_FOLDER:07d}" / f"{name}.npz"

    def get(self, objects_seed: int, seed: int) -> Layout:
        """The layout of two seeds (see `sample_layout`), from its file if there is one, else made and kept.

        Raises:
            LayoutError: there is no such layout. Nothing is kept of that.
        """
        path = self.path(objects_seed, seed)
        if path.is_file():
            try:
                return read_layout(path)
            except (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile) as error:
                _log.warning("%s: damaged, made again (%s)", path, error)
        layout = self._sample(objects_seed, seed)
        if not (self.folder / ABOUT).is_file():
            make_folder(self.folder)
            write_json(self.folder / ABOUT, self._about)
        make_folder(path.parent)
        write_layout(layout, path)
        return layout

    __call__ = get  # a bank is a source of layouts

    def missing(self, pairs: Iterable[Pair]) -> list[Pair]:
        """Those of some pairs of seeds whose layouts are not there yet."""
        return [pair for pair in pairs if not self.path(*pair).is_file()]

    def count(self) -> int:
        """How many layouts there are."""
        return count_layouts(self.folder)


def count_layouts(folder: Path) -> int:
    """How many layouts a bank's folder holds."""
    return sum(1 for path in folder.glob("*/*.npz") if not path.name.startswith("."))


def pairs_of(seeds: Iterable[int], objects: Iterable[int] | None = None) -> list[Pair]:
    """Pairs of seeds whose layouts environments ask for.

    Args:
        seeds: of layouts.
        objects: seeds of objects, as several envs have them: each goes with all ``seeds``, and first with itself, which
            is the layout its env is built with. None: as one env has it, objects and layout of one seed.
    """
    if objects is None:
        return [(seed, seed) for seed in seeds]
    seeds = list(seeds)
    return [(chosen, seed) for chosen in objects for seed in dict.fromkeys([chosen, *seeds])]


def fill(bank: LayoutBank, pairs: Iterable[Pair], jobs: int = 1) -> Generator[tuple[Pair, str], None, None]:
    """Make the layouts that a bank lacks.

    Args:
        bank: to fill.
        pairs: of seeds, those wanted.
        jobs: processes; the outcome does not depend on it.

    Yields:
        Each pair when it is done, in any order, and why there is no layout, or an empty text.
    """
    missing = bank.missing(pairs)
    if jobs <= 1 or len(missing) < 2:
        for pair in missing:
            yield pair, _make(bank, pair)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(jobs, len(missing)), context, _start_worker, (bank,)) as pool:
        try:
            for done in as_completed([pool.submit(_make_in_worker, pair) for pair in missing]):
                yield done.result()
        except BaseException:  # an interruption too: only what is under way is waited for
            pool.shutdown(wait=True, cancel_futures=True)
            raise


def _make(bank: LayoutBank, pair: Pair) -> str:
    try:
        bank.get(*pair)
    except LayoutError as error:
        return str(error)
    return ""


_worker_bank: list[LayoutBank] = []


def _start_worker(bank: LayoutBank) -> None:
    _worker_bank.append(bank)


def _make_in_worker(pair: Pair) -> tuple[Pair, str]:
    return pair, _make(_worker_bank[0], pair)


def about(model: SceneModel) -> dict[str, Any]:
    """Everything that layouts depend on besides their seeds."""
    config = model.config.model_dump(mode="json", exclude=set(_NO_MATTER))
    config["randomisation"] = {
        k: v for k, v in config["randomisation"].items() if k not in {"room", "lights", "cameras"}
    }
    config.pop("room")
    parts: dict[str, LoadedFurniture] = {**model.furniture, "basket": model.basket}
    return {
        "layout_format": LAYOUT_FORMAT,
        "config": config,
        "object_pack": {"name": model.object_pack.name, "manifest": sha256(model.object_pack.root / MANIFEST)},
        "furniture": {name: part.asset.model_dump(mode="json", exclude={"quality"}) for name, part in parts.items()},
        "versions": {name: version(name) for name in ("sapien", "numpy", "scipy", "shapely", "trimesh", "embreex")},
    }


def write_layout(layout: Layout, path: Path) -> None:
    """Write a layout as ``.npz``."""
    with replacing(path) as tmp, tmp.open("wb") as file:
        np.savez(file, **{f.name: np.asarray(getattr(layout, f.name)) for f in fields(Layout)})


def read_layout(path: Path) -> Layout:
    """Read a layout.

    Raises:
        ValueError: or OSError, KeyError, BadZipFile: the file is damaged.
    """
    with np.load(path, allow_pickle=False) as file:
        values = {f.name: file[f.name] for f in fields(Layout)}
    return Layout(
        **{
            **values,
            "object_ids": tuple(values["object_ids"].tolist()),
            "target": int(values["target"]),
            "relation": str(values["relation"]),
        }
    )
