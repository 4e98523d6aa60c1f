"""The layout bank: layouts made ahead or on demand, and kept, so that a reset only sets poses."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields
from importlib.metadata import version
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from robocas_ms3.assets.pack import MANIFEST, LoadedFurniture, sha256
from robocas_ms3.core.documents import DAMAGED, open_arrays
from robocas_ms3.core.errors import LayoutError
from robocas_ms3.core.files import make_folder, open_for_append, replacing, write_json
from robocas_ms3.core.locks import lock_file
from robocas_ms3.core.paths import cache_dir
from robocas_ms3.scenes.frozen import FrozenLayouts
from robocas_ms3.scenes.layout import Layout
from robocas_ms3.scenes.model import SceneModel
from robocas_ms3.scenes.source import LayoutSource, Sampler
from robocas_ms3.scenes.table import Engine, LayoutTable, Pair, State, mark_table, write_table

LAYOUT_FORMAT = 14  # raised when the same seed gives another layout, or the files change
ABOUT = "about.json"  # in the folder of a bank: all that its layouts depend on
_A_FOLDER = 1000  # layouts in one
_NO_MATTER = (
    "description",
    "support",
    "lights",
    "robot_start",
    "language",
    "base_motion",
    "static_camera",
)  # parts of a configuration
_log = logging.getLogger(__name__)


def layout_bank(model: SceneModel, folder: str | Path | LayoutSource | None = "auto") -> LayoutSource:
    """Where an environment gets its layouts from.

    Args:
        model: the scene's assets.
        folder: of all banks; ``auto``: in the cache; None: no bank, every layout is sampled anew; a file: of frozen
            layouts; or a source itself.
    """
    if callable(folder):
        return folder
    if str(folder).endswith(".npy"):
        return FrozenLayouts(Path(str(folder)), model.object_pack.objects)
    return Sampler(model) if folder is None else LayoutBank(model, folder)


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
        self._names = sorted(model.object_pack.objects)
        self._about = about(model)
        key = hashlib.sha256(json.dumps(self._about, sort_keys=True).encode()).hexdigest()[:16]
        self.folder = banks_folder(root) / f"{model.config.task}-{key}"

    def table(self, engine: Engine) -> LayoutTable | None:
        """Its layouts as one mapped file, if that was written for an engine; a damaged one is none."""
        path = self.table_path(engine)
        if not path.is_file():
            return None
        try:
            return LayoutTable(path, self._names)
        except LayoutError as error:
            _log.warning("%s", error)
            return None

    def table_path(self, engine: Engine) -> Path:
        """Where an engine's table is kept."""
        return self.folder / f"table-{engine}.npy"

    def write_table(self, engine: Engine, pairs: Iterable[Pair]) -> LayoutTable | None:
        """Write those layouts of some pairs of seeds that are there as one file (`LayoutTable`), if any is.

        What an earlier file holds stays in it.
        """
        with self._alone():
            before = self.table(engine)
            states = {pair: before.state(pair) for pair in before.pairs()} if before else {}
            layouts: dict[Pair, Layout] = {}
            for pair in dict.fromkeys([*states, *pairs]):
                if self.path(*pair).is_file():
                    layouts[pair] = self.get(*pair)
                elif before is not None and (tabled := before.layout(pair)) is not None:
                    layouts[pair] = tabled
            if layouts:
                write_table(self.table_path(engine), self._names, layouts, states)
            return self.table(engine)

    def mark_table(self, engine: Engine, states: Mapping[Pair, State]) -> None:
        """Write into the table what its engine has found of layouts; those that it lacks it goes on lacking."""
        with self._alone():
            mark_table(self.table_path(engine), self._names, states)

    @contextmanager
    def _alone(self) -> Iterator[None]:
        """While no other process changes the tables: each change begins with what is there."""
        with open_for_append(make_folder(self.folder) / ".tables.lock") as file:
            lock_file(file, self.folder, wait=True)
            yield

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
                layout = read_layout(path)
                layout.check(self._names)
                return layout
            except (*DAMAGED, KeyError, TypeError) as error:
                _log.warning("%s: damaged, made again (%s)", path, error)
        known = None if objects_seed == seed else self.get(objects_seed, objects_seed).object_ids
        layout = self._sample.make(objects_seed, seed, known)
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


def about(model: SceneModel) -> dict[str, Any]:
    """Everything that layouts depend on besides their seeds."""
    config = model.config.model_dump(mode="json", exclude=set(_NO_MATTER))
    config["randomisation"] = {
        k: v for k, v in config["randomisation"].items() if k not in {"room", "finishes", "lights", "cameras"}
    }
    config.pop("room")
    parts: dict[str, LoadedFurniture] = {**model.furniture, **({"basket": model.basket} if model.basket else {})}
    return {
        "layout_format": LAYOUT_FORMAT,
        "config": config,
        "object_pack": {"name": model.object_pack.name, "manifest": sha256(model.object_pack.root / MANIFEST)},
        "furniture": {name: part.asset.model_dump(mode="json", exclude={"quality"}) for name, part in parts.items()},
        "versions": {name: version(name) for name in ("sapien", "numpy", "scipy", "shapely", "trimesh", "embreex")},
    }


def write_layout(layout: Layout, path: Path) -> None:
    """Write a layout as ``.npz``."""
    values = {f.name: getattr(layout, f.name) for f in fields(Layout)}
    arrays: dict[str, Any] = {
        name: np.zeros(0) if value is None else np.asarray(value) for name, value in values.items()
    }
    made = BytesIO()  # a zip file that meets a full disk complains once more when it is forgotten
    np.savez(made, **arrays)
    with replacing(path) as tmp:
        tmp.write_bytes(made.getbuffer())


def read_layout(path: Path) -> Layout:
    """Read a layout.

    Raises:
        ValueError: or another of `documents.DAMAGED`, or KeyError or TypeError: the file is damaged.
    """
    with open_arrays(path) as file:
        values = {f.name: file[f.name] for f in fields(Layout)}
    return Layout(
        **{
            **values,
            "basket_pose": values["basket_pose"] if values["basket_pose"].size else None,
            "object_ids": tuple(values["object_ids"].tolist()),
            "target": int(values["target"]),
            "relation": str(values["relation"]),
        }
    )
