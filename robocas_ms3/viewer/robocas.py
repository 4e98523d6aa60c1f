"""A RoboCAS folder, of ours or of upstream's, as the page shows it."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.datasets import schema
from robocas_ms3.datasets.reader import Dataset, Episode
from robocas_ms3.datasets.tolerant import DAMAGED
from robocas_ms3.errors import DatasetError
from robocas_ms3.viewer.arrays import NEEDED, show_arrays
from robocas_ms3.viewer.failures import of_seed, read_failures, stages
from robocas_ms3.viewer.source import Picture, inside_path, make_index, row

MEDIA_TYPES = {".png": "image/png", ".jpg": "image/jpeg", ".webp": "image/webp"}


class RoboCASSource:
    """A dataset's folder; pictures are handed on as they are stored."""

    def __init__(self, root: Path) -> None:
        """Open it.

        Raises:
            DatasetError: there are no episodes.
        """
        self.root = root
        self.dataset = Dataset(root)
        self._known = frozenset(self.dataset.numbers)
        self.failures = read_failures(root)
        self._open = lru_cache(maxsize=16)(self._open_now)

    def index(self) -> dict[str, Any]:
        """From the dataset's own overviews and each ``scene.json``; arrays are read only where both are silent."""
        info, ledger = self.dataset.info, self.dataset.settings.get("episodes", {})
        val = set(info.get("val_eps", ()))
        rows = []
        for number in self.dataset.numbers:
            episode = Episode(self.root / schema.episode_folder(number))
            scene, entry = _scene(episode), ledger.get(str(number), {})
            recorded = scene.get("recorded") or {}
            seed = scene.get("seed", entry.get("seed"))
            failures = of_seed(self.failures, seed)
            rows.append(
                row(
                    number,
                    steps=info.get("ep_length", {}).get(str(number)) or _steps(episode),
                    instruction=info.get("language_goal", {}).get(str(number), ""),
                    task=scene.get("task") or "",
                    target=(scene.get("target") or entry.get("target") or {}).get("name", ""),
                    seed=seed,
                    success=scene.get("success", entry.get("success")),
                    split="" if not info else "val" if number in val else "train",
                    stages=stages(failures, recorded),
                    attempts=recorded.get("attempts"),
                )
            )
        first = self.dataset.episode(self.dataset.numbers[0])
        rate = self.dataset.rate_hz
        return make_index(self.root, "RoboCAS folder", rate, first.cameras, first.has_depth, rows)

    def episode(self, number: int) -> dict[str, Any]:
        """Arrays as plots, sub-goals, and the TCP's path among the objects where they stood at the start."""
        episode = self._open(number)
        scene = _scene(episode)
        failures = of_seed(self.failures, scene.get("seed"))
        return show_arrays(number, _arrays(episode), scene, self.dataset.rate_hz, failures)

    def rgb(self, number: int, camera: str, step: int) -> Picture:
        """The file."""
        path = inside_path(self._open(number).image_path(camera, "rgb", step), self.root)
        try:
            return Picture(MEDIA_TYPES[path.suffix], path.read_bytes())
        except OSError as error:
            raise DatasetError("no such picture", where=path, found=error.strerror) from error

    def depth(self, number: int, camera: str, step: int) -> NDArray[np.uint16]:
        """The file, decoded."""
        episode = self._open(number)
        inside_path(episode.image_path(camera, "depth", step), self.root)
        return episode.depth(camera, step)

    def _open_now(self, number: int) -> Episode:
        if number not in self._known:
            raise DatasetError("no such episode", where=self.root, found=number)
        return self.dataset.episode(number)


def _scene(episode: Episode) -> dict[str, Any]:
    try:
        return episode.scene
    except DatasetError:
        return {}  # the validator reports it; what else the episode has can still be seen


def _arrays(episode: Episode) -> dict[str, NDArray]:
    try:
        arrays = episode.arrays
        missing = sorted(set(NEEDED) - set(arrays))
        if missing:
            raise ValueError(f"without {', '.join(missing)}")
        return arrays
    except (*DAMAGED, KeyError) as error:
        raise DatasetError(
            "this episode can't be read",
            where=episode.folder,
            found=str(error).splitlines()[0] if str(error) else type(error).__name__,
            fix="robocas validate says what is wrong.",
        ) from error


def _steps(episode: Episode) -> int:
    try:
        with np.load(episode.folder / schema.EPISODE_FILE, allow_pickle=False) as content:
            return int(content["episode_length"]) if "episode_length" in content else len(content["ee_pos"])
    except (*DAMAGED, KeyError):
        return 0
