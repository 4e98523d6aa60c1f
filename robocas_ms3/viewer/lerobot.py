"""A LeRobot dataset (v3.0 or v2.1) on the page: those of `robocas convert` in full, others by their columns."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets.lerobot import schema
from robocas_ms3.datasets.lerobot.reader import LeRobotDataset
from robocas_ms3.datasets.sources.protocol import Kind
from robocas_ms3.viewer.content import PageContent
from robocas_ms3.viewer.damage import read_object, readable, split_of
from robocas_ms3.viewer.episode import plot
from robocas_ms3.viewer.images import check_inside

_AT_ONCE = 8  # images decoded together: a video opens and seeks slowly, and the next step is asked for next
_CACHE_BYTES = 128e6  # of decoded images


class LeRobotContent(PageContent):
    """The folder of a dataset; images are decoded from its videos.

    Raises:
        DatasetError: it is of another version, or damaged; damaged additions of ours are left out with a note.
        MissingExtraError: pyarrow or av is missing.
    """

    entry_name = schema.CONVERSION_FILE

    def __init__(self, root: Path) -> None:
        with readable(root):
            self.dataset = dataset = LeRobotDataset(root)
            _ = dataset.is_ours, dataset.lengths, dataset.rate_hz, dataset.cameras, dataset.has_depth
        dataset.settings, wrong_settings = read_object(lambda: dataset.settings, schema.CONVERSION_FILE)
        dataset.described, wrong_scenes = read_object(lambda: dataset.described, schema.SCENES_FILE)
        notes = wrong_scenes, wrong_settings
        super().__init__(dataset, "LeRobot dataset", notes=notes, split=split_of(dataset.settings))
        self._decoded: OrderedDict[tuple[int, str, Kind, int], NDArray] = OrderedDict()  # the last used is last

    def _show(self, number: int, scene: Mapping[str, Any]) -> dict[str, Any]:
        """Show ours like a RoboCAS folder, others by a plot per numeric column."""
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

    def _image(self, number: int, camera: str, kind: Kind, step: int) -> NDArray:
        episode = self.dataset.episode(number)
        if not 0 <= step < episode.steps:
            raise DatasetError("no such step", where=f"{self.root}, episode {number}", found=step)
        first = step - step % _AT_ONCE
        key = number, camera, kind, first
        with self._reading:
            if key not in self._decoded:
                check_inside(episode.video(camera, kind)[0], self.root)
                frames = episode.frames(camera, kind, first, min(_AT_ONCE, episode.steps - first))
                self._decoded[key] = np.stack(list(frames))
            self._decoded.move_to_end(key)
            while len(self._decoded) > 1 and sum(images.nbytes for images in self._decoded.values()) > _CACHE_BYTES:
                self._decoded.popitem(last=False)
            return self._decoded[key][step - first]


def _names(feature: dict[str, Any], width: int) -> list[str]:
    """Return the names of a feature's numbers; datasets have a list, a dictionary of lists, or nothing."""
    names = feature.get("names")
    if isinstance(names, dict):
        names = [str(word) for part in names.values() for word in (part if isinstance(part, list) else [part])]
    return [str(name) for name in names] if names and len(names) == width else [str(i) for i in range(width)]
