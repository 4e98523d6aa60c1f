"""A RoboCAS folder, of ours or of upstream's, as the page shows it."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.datasets import schema
from robocas_ms3.datasets.sources.reader import Dataset, Episode
from robocas_ms3.datasets.sources.tolerant import DAMAGED
from robocas_ms3.errors import DatasetError
from robocas_ms3.recordings.seeds import one_seed
from robocas_ms3.viewer import damage
from robocas_ms3.viewer.arrays import NEEDED, show_arrays
from robocas_ms3.viewer.damage import entry_of, integer, ledger_entry, rate_of, readable, split_of, table, text
from robocas_ms3.viewer.failures import Failures, stages
from robocas_ms3.viewer.source import Picture, inside_path, make_index, row

RATE_HZ = 5.0  # upstream's
MEDIA_TYPES = {".png": "image/png", ".jpg": "image/jpeg", ".webp": "image/webp"}


class RoboCASSource:
    """A dataset's folder; pictures are handed on as they are stored."""

    def __init__(self, root: Path) -> None:
        """Open it; damaged overviews are left out, and the page says so.

        Raises:
            DatasetError: there are no episodes.
        """
        self.root = root
        self.dataset = Dataset(root)
        self._known = frozenset(self.dataset.numbers)
        self.failures = Failures.read(root)
        self._info, wrong_info = table(lambda: self.dataset.info, schema.DATA_INFO_FILE)
        self._settings, wrong_settings = table(lambda: self.dataset.settings, schema.CONVERSION_FILE)
        self.rate_hz, wrong_rate = rate_of(self._settings, schema.CONVERSION_FILE, RATE_HZ)
        self._note = " ".join(filter(None, (wrong_settings, wrong_rate, wrong_info, self.failures.note)))
        self._open = lru_cache(maxsize=16)(self._open_now)

    def index(self) -> dict[str, Any]:
        """From the dataset's own overviews and each ``scene.json``; arrays are read only where both are silent.

        Seeds without an episode, from ``failures.jsonl``, come last.
        """
        split = split_of(self._info)
        found = [self._row(number, split.get(number, "")) for number in self.dataset.numbers]
        rows, env_infos = [row for row, _ in found], [env_info for _, env_info in found]
        first = self.dataset.episode(self.dataset.numbers[0])
        rows += self.failures.given_up(rows, env_infos)
        return make_index(self.root, "RoboCAS folder", self.rate_hz, first.cameras, first.has_depth, rows, self._note)

    def _row(self, number: int, split: str) -> tuple[dict[str, Any], Any]:
        episode = Episode(self.root / schema.episode_folder(number))
        scene, wrong = damage.scene(lambda: episode.scene)
        entry, wrong_entry = ledger_entry(self._settings.get("episodes"), number, schema.CONVERSION_FILE)
        recorded = scene.get("recorded") or {}
        seed = one_seed(scene.get("seed", entry.get("seed")))
        said = integer(entry_of(self._info.get("ep_length"), number)) or 0
        steps, wrong_steps = (said, "") if said > 0 else _steps(episode)
        env_info = scene.get("env_info")
        shown = row(
            number,
            steps=steps,
            instruction=text(entry_of(self._info.get("language_goal"), number)),
            task=scene.get("task") or "",
            target=(scene.get("target") or entry.get("target") or {}).get("name", ""),
            seed=seed,
            success=scene.get("success", entry.get("success")),
            split=split,
            stages=stages(self.failures.of_seed(seed, env_info), recorded),
            attempts=recorded.get("attempts"),
            damage="; ".join(filter(None, (wrong, wrong_entry, wrong_steps))),
        )
        return shown, env_info

    def episode(self, number: int) -> dict[str, Any]:
        """Arrays as plots, sub-goals, and the TCP's path among the objects where they stood at the start."""
        episode = self._open(number)
        scene, _ = damage.scene(lambda: episode.scene)  # the table says what is wrong
        failures = self.failures.of_seed(one_seed(scene.get("seed")), scene.get("env_info"))
        return show_arrays(number, _arrays(episode), scene, self.rate_hz, failures)

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


def _steps(episode: Episode) -> tuple[int, str]:
    try:
        with (
            readable(schema.EPISODE_FILE),
            np.load(episode.folder / schema.EPISODE_FILE, allow_pickle=False) as content,
        ):
            return int(content["episode_length"]) if "episode_length" in content else len(content["ee_pos"]), ""
    except DatasetError as error:
        return 0, f"{error.where}: {error.what}, {error.found}"
