"""A LeRobot dataset (v3.0 or v2.1) on the page: those of `robocas convert` in full, others by their columns."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets.lerobot import schema
from robocas_ms3.datasets.lerobot.reader import LeRobotDataset
from robocas_ms3.datasets.sources.protocol import Kind
from robocas_ms3.viewer.content import PageContent
from robocas_ms3.viewer.damage import readable, split_of, table
from robocas_ms3.viewer.episode import plot
from robocas_ms3.viewer.pictures import inside

_AT_ONCE = 8  # images decoded together: a video opens and seeks slowly, and the next step is asked for next
_CACHED = 16  # such groups in memory: 118 MB at 640 x 480


class LeRobotContent(PageContent):
    """A dataset's folder; pictures are decoded from its videos."""

    entry_name = schema.CONVERSION_FILE

    def __init__(self, root: Path) -> None:
        """Open it; damaged additions of ours are left out, and the page says so.

        Raises:
            DatasetError: it is of another version, or damaged.
            MissingExtraError: pyarrow or av is missing.
        """
        with readable(root):
            self.dataset = dataset = LeRobotDataset(root)
            _ = dataset.is_ours, dataset.lengths, dataset.rate_hz, dataset.cameras, dataset.has_depth
        dataset.settings, wrong_settings = table(lambda: dataset.settings, schema.CONVERSION_FILE)
        dataset.described, wrong_scenes = table(lambda: dataset.described, schema.SCENES_FILE)
        notes = wrong_scenes, wrong_settings
        super().__init__(dataset, "LeRobot dataset", notes=notes, split=split_of(dataset.settings))
        self._decoded = lru_cache(maxsize=_CACHED)(self._decode)

    def _show(self, number: int, scene: Mapping[str, Any]) -> dict[str, Any]:
        """As a RoboCAS folder is shown, or each numeric column as a plot."""
        if self.dataset.is_ours:
            return super()._show(number, scene)
        episode = self.dataset.episode(number)
        features, skipped = self.dataset.info["features"], {*schema.INDICES, schema.SUBTASK_INDEX.key}
        plots = []
        for name, values in episode.columns.items():
            if name not in skipped and values.ndim == 2 and np.issubdtype(values.dtype, np.number):
                plots.append(plot(name, "", _names(features.get(name, {}), values.shape[1]), values))
        return {
            "instruction": episode.instruction,
            "steps": episode.steps,
            "subgoals": [],
            "plots": plots,
            "trace": None,
            "facts": {"Robot": self.dataset.info.get("robot_type")},
        }

    def _picture(self, number: int, camera: str, kind: Kind, step: int) -> NDArray:
        if not 0 <= step < self.dataset.episode(number).steps:
            raise DatasetError("no such step", where=f"{self.root}, episode {number}", found=step)
        with self._reading:
            return self._decoded(number, camera, kind, step // _AT_ONCE)[step % _AT_ONCE]

    def _decode(self, number: int, camera: str, kind: Kind, group: int) -> list[NDArray]:
        episode, first = self.dataset.episode(number), group * _AT_ONCE
        inside(episode.video(camera, kind)[0], self.root)
        return list(episode.frames(camera, kind, first, min(_AT_ONCE, episode.steps - first)))


def _names(feature: dict[str, Any], width: int) -> list[str]:
    """Names of a feature's numbers; datasets give a list, a dictionary of lists, or nothing."""
    names = feature.get("names")
    if isinstance(names, dict):
        names = [str(word) for part in names.values() for word in (part if isinstance(part, list) else [part])]
    return [str(name) for name in names] if names and len(names) == width else [str(i) for i in range(width)]
