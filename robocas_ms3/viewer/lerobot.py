"""A LeRobot dataset (v3.0) as the page shows it: those of `robocas convert` in full, others by their columns."""

from __future__ import annotations

import json
import threading
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.datasets.lerobot import schema
from robocas_ms3.datasets.lerobot.reader import LeRobotDataset, LeRobotEpisode
from robocas_ms3.errors import DatasetError
from robocas_ms3.recordings.seeds import one_seed
from robocas_ms3.viewer import damage
from robocas_ms3.viewer.arrays import show_arrays
from robocas_ms3.viewer.damage import ledger_entry, readable, split_of, table
from robocas_ms3.viewer.failures import Failures, stages
from robocas_ms3.viewer.kept import KeptPictures
from robocas_ms3.viewer.pictures import encode_jpeg
from robocas_ms3.viewer.source import Picture, inside_path, make_episode, make_index, plot, row

_AT_ONCE = 8  # pictures decoded together: a video opens and seeks slowly, and who looks at one looks at the next
_KEPT = 128 * 2**20  # bytes of such groups in memory: 17 of 640 x 480


class LeRobotSource:
    """A dataset's folder; pictures are decoded from its videos."""

    def __init__(self, root: Path) -> None:
        """Open it; damaged additions of ours are left out, and the page says so.

        Raises:
            DatasetError: it is of another version, or damaged.
            MissingExtraError: pyarrow or av is missing.
        """
        self.root = root
        self.failures = Failures.read(root)
        with readable(root):
            self.dataset = LeRobotDataset(root)
            self.ours = {feature.key for feature in schema.FEATURES} <= set(self.dataset.info["features"])
            self._known = frozenset(self.dataset.numbers)
            self._pictures = self.dataset.rate_hz, self.dataset.cameras, self.dataset.has_depth
        self._settings, wrong = table(lambda: self.dataset.settings, schema.CONVERSION_FILE)
        self._note = " ".join(filter(None, (wrong, self.failures.note)))
        self._open = lru_cache(maxsize=16)(self._open_now)
        self._kept = KeptPictures(_KEPT)
        self._decoding = threading.Lock()

    def index(self) -> dict[str, Any]:
        """From ``meta/episodes`` and, where it is one of ours, ledger and scenes of its conversion."""
        texts, wrong = table(self._scenes, schema.SCENES_FILE)
        split = split_of(self._settings)
        found = [self._row(entry, texts, split) for entry in self.dataset.rows]
        rows, env_infos = [row for row, _ in found], [env_info for _, env_info in found]
        rows += self.failures.given_up(rows, env_infos)
        note = " ".join(filter(None, (wrong, self._note)))
        rate_hz, cameras, has_depth = self._pictures
        return make_index(self.root, "LeRobot dataset", rate_hz, cameras, has_depth, rows, note)

    def _row(self, entry: dict[str, Any], texts: dict[int, str], split: dict[int, str]) -> tuple[dict, Any]:
        number = int(entry["episode_index"])
        scene, wrong = damage.scene(lambda: json.loads(texts.get(number, "null")))
        made, wrong_made = ledger_entry(self._settings.get("episodes"), number, schema.CONVERSION_FILE)
        recorded, tasks = scene.get("recorded") or {}, entry.get("tasks") or [""]
        seed = one_seed(made.get("seed"))
        env_info = scene.get("env_info")
        shown = row(
            number,
            steps=int(entry["length"]),
            instruction=str(tasks[0]),
            task=scene.get("task") or "",
            target=(made.get("target") or {}).get("name", ""),
            seed=seed,
            success=made.get("success"),
            split=split.get(number, ""),
            stages=stages(self.failures.of_seed(seed, env_info), recorded),
            attempts=recorded.get("attempts"),
            damage="; ".join(filter(None, (wrong, wrong_made))),
        )
        return shown, env_info

    def episode(self, number: int) -> dict[str, Any]:
        """As a RoboCAS folder shows it, or each numeric column as a plot."""
        episode, rate = self._open(number), self.dataset.rate_hz
        if self.ours:
            scene, _ = damage.scene(lambda: episode.scene)  # the table says what is wrong
            failures = self.failures.of_seed(one_seed(scene.get("seed")), scene.get("env_info"))
            return show_arrays(number, episode.arrays, scene, rate, failures)
        features, skipped = self.dataset.info["features"], {*schema.INDICES, schema.SUBTASK_INDEX.key}
        plots = []
        for name, values in episode.columns.items():
            if name not in skipped and values.ndim == 2 and np.issubdtype(values.dtype, np.number):
                plots.append(plot(name, "", _names(features.get(name, {}), values.shape[1]), values))
        tasks = episode.row.get("tasks") or [""]
        return make_episode(
            number,
            instruction=str(tasks[0]),
            steps=episode.steps,
            rate_hz=rate,
            subgoals=[],
            plots=plots,
            trace=None,
            facts={"Robot": self.dataset.info.get("robot_type")},
        )

    def rgb(self, number: int, camera: str, step: int) -> Picture:
        """A frame of the video."""
        return encode_jpeg(self._frame(number, camera, "rgb", step))

    def depth(self, number: int, camera: str, step: int) -> NDArray[np.uint16]:
        """A frame of the depth's video."""
        return self._frame(number, camera, "depth", step)

    def _scenes(self) -> dict[int, str]:
        """Text of ``scene.json`` by episode; empty where the dataset is not one of ours."""
        import pyarrow.parquet as pq

        path = self.root / schema.SCENES_FILE
        if not path.is_file():
            return {}
        found = pq.read_table(path, columns=["episode_index", "scene"])
        numbers, texts = (found.column(name).to_pylist() for name in ("episode_index", "scene"))
        return {int(number): text for number, text in zip(numbers, texts, strict=True)}

    def _frame(self, number: int, camera: str, kind: str, step: int) -> NDArray:
        if not 0 <= step < self._open(number).steps:
            raise DatasetError("no such step", where=f"{self.root}, episode {number}", found=step)
        with self._decoding:
            key = number, camera, kind, step // _AT_ONCE
            return self._kept.get(key, lambda: self._decode(*key))[step % _AT_ONCE]

    def _decode(self, number: int, camera: str, kind: str, group: int) -> list[NDArray]:
        episode, first = self._open(number), group * _AT_ONCE
        inside_path(episode.video(camera, kind)[0], self.root)
        return list(episode.frames(camera, kind, first, min(_AT_ONCE, episode.steps - first)))

    def _open_now(self, number: int) -> LeRobotEpisode:
        if number not in self._known:
            raise DatasetError("no such episode", where=self.root, found=number)
        return self.dataset.episode(number)


def _names(feature: dict[str, Any], width: int) -> list[str]:
    """Names of a feature's numbers; datasets give a list, a dictionary of lists, or nothing."""
    names = feature.get("names")
    if isinstance(names, dict):
        names = [str(word) for part in names.values() for word in (part if isinstance(part, list) else [part])]
    return [str(name) for name in names] if names and len(names) == width else [str(i) for i in range(width)]
