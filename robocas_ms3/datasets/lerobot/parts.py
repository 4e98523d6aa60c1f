"""Read the parts of a conversion: the tables and descriptions that `stage` wrote."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from robocas_ms3.core.documents import load_json
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets.lerobot import schema
from robocas_ms3.datasets.lerobot.language import (
    EVENTS,
    EVENTS_TYPE,
    PERSISTENT,
    PERSISTENT_TYPE,
    Row,
    paraphrases,
    persistent_rows,
)
from robocas_ms3.datasets.lerobot.stage import EPISODE_FILE, FRAMES_FILE, SUBGOAL
from robocas_ms3.datasets.lerobot.stats import Range
from robocas_ms3.datasets.lerobot.table_writing import column
from robocas_ms3.datasets.lerobot.tables import numbers
from robocas_ms3.datasets.lerobot.variants import Variant
from robocas_ms3.demos.recordings.subgoals import subgoal_runs


@dataclass
class Texts:
    """Texts and their numbers, in the order in which they occur.

    Attributes:
        tasks: instructions.
        subgoals: texts of sub-goals.
    """

    tasks: dict[str, int] = field(default_factory=dict)
    subgoals: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class Part:
    """An episode that was written by itself.

    Attributes:
        folder: of it.
        index: of the episode in the dataset.
        start: index of its first frame in the dataset.
        success: whether the episode is known to have succeeded.
    """

    folder: Path
    index: int
    start: int
    success: bool

    @cached_property
    def about(self) -> dict[str, Any]:
        """What `stage` says of it.

        Raises:
            DatasetError: it is damaged.
        """
        path = self.folder / EPISODE_FILE
        try:
            return load_json(path)
        except (OSError, ValueError) as error:
            raise _damaged(path) from error

    @cached_property
    def table(self) -> pa.Table:
        """Its frames.

        Raises:
            DatasetError: they are damaged.
        """
        path = self.folder / FRAMES_FILE
        try:
            return pq.read_table(path)
        except (OSError, pa.ArrowException) as error:
            raise _damaged(path) from error

    @property
    def steps(self) -> int:
        """Number of frames."""
        return len(self.table)

    def columns(self, variant: Variant, texts: Texts) -> dict[str, NDArray]:
        """Return the numeric features (T, D), with the numbers that follow from the episodes before."""
        steps = self.steps
        found = {key: numbers(self.table.column(key)) for key in numeric(variant) if key in self.table.column_names}
        last = np.arange(steps)[:, None] == steps - 1
        made = {
            "episode_index": np.full((steps, 1), self.index, np.int64),
            "index": np.arange(self.start, self.start + steps)[:, None],
            "task_index": np.full((steps, 1), texts.tasks[self.about["instruction"]], np.int64),
            schema.REWARD.key: (last & self.success).astype(np.float32),
            schema.SUCCESS.key: last & self.success,
            schema.DONE.key: last,
        }
        if not variant.language:
            places = [texts.subgoals[text] for text in self.table.column(SUBGOAL).to_pylist()]
            made[schema.SUBTASK_INDEX.key] = np.array(places, np.int64)[:, None]
        return {key: {**found, **made}[key] for key in numeric(variant)}

    def persistent(self, fps: int) -> list[Row]:
        """Return the persistent language rows of the episode."""
        types, goals = (self.table.column(key).to_pylist() for key in (schema.SUBGOAL_TYPE.key, SUBGOAL))
        return persistent_rows(
            subgoal_runs(types, goals), paraphrases(self.about["scene"], self.about["instruction"]), fps
        )

    def data(self, variant: Variant, columns: dict[str, NDArray], persistent: list[Row]) -> pa.Table:
        """Return the rows of the data, columns in the order of the features."""
        made: dict[str, Any] = {feature.key: column(columns[feature.key]) for feature in schema.FEATURES}
        for feature in schema.single_features(variant):
            is_text = feature.dtype == "string"
            made[feature.key] = self.table.column(feature.key) if is_text else column(columns[feature.key])
        if variant.language:
            same = pa.array(np.zeros(self.steps, np.int64))  # every frame has all rows of its episode
            made[PERSISTENT] = pa.array([persistent], PERSISTENT_TYPE).take(same)
            made[EVENTS] = self.table.column(EVENTS).cast(EVENTS_TYPE)
        for key in schema.INDICES:
            made[key] = column(columns[key])
        return pa.table(made)


def numeric(variant: Variant) -> tuple[str, ...]:
    """Return the keys of the numeric features that are stored in tables."""
    single = (feature.key for feature in schema.single_features(variant) if feature.dtype != "string")
    return (*(feature.key for feature in schema.FEATURES), *single, *schema.INDICES)


def read_parts(folders: Sequence[Path], entries: Sequence[dict[str, Any]]) -> Iterator[Part]:
    """Yield the parts of a plan in order, one in memory at a time.

    Args:
        folders: of the parts.
        entries: of ``conversion.json``, which say which episodes succeeded.
    """
    start = 0
    for index, (folder, entry) in enumerate(zip(folders, entries, strict=True)):
        part = Part(folder, index, start, entry.get("success") is True)
        yield part
        start += part.steps


def survey(parts: Iterable[Part], variant: Variant) -> tuple[Texts, dict[str, Range]]:
    """Number texts as they come, and find the range of every feature, which histograms need beforehand."""
    texts, ranges = Texts(), {key: Range() for key in numeric(variant)}
    for part in parts:
        texts.tasks.setdefault(part.about["instruction"], len(texts.tasks))
        for text in part.table.column(SUBGOAL).to_pylist():
            texts.subgoals.setdefault(text, len(texts.subgoals))
        columns = part.columns(variant, texts)
        for key, found in ranges.items():
            found.add(columns[key])
    return texts, ranges


def _damaged(path: Path) -> DatasetError:
    return DatasetError("this part of a conversion is damaged", where=path, fix="Pass --overwrite.")
