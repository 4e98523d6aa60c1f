"""Write what ``meta`` says of each episode: the tables of format v3.0, the JSON lines of v2.1, rows to annotate."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import pyarrow as pa

from robocas_ms3.datasets.lerobot.language import Row
from robocas_ms3.datasets.lerobot.schema import (
    EPISODES_LINES,
    EPISODES_PATH,
    STAGING,
    STATS_LINES,
    TASKS_FILE,
    TASKS_LINES,
    Limits,
)
from robocas_ms3.datasets.lerobot.table_writing import RollingTable, write_texts
from robocas_ms3.datasets.lerobot.variants import V3, Layout

GROUP = 64
"""Episodes per row group of the tables about episodes."""


class EpisodesWriter(Protocol):
    """Write one record per episode."""

    def add(self, row: dict[str, Any], stats: Mapping[str, Mapping[str, Any]]) -> None:
        """Append an episode.

        Args:
            row: its index, tasks, length and files.
            stats: statistics by feature.
        """
        ...

    def close(self) -> None:
        """Finish the files."""
        ...


class EpisodesTable:
    """Write ``meta/episodes`` of format v3.0."""

    def __init__(self, root: Path, limits: Limits) -> None:
        self._rows = RollingTable(partial(V3.path, root, EPISODES_PATH), limits.data_mb, group=GROUP)

    def add(self, row: dict[str, Any], stats: Mapping[str, Mapping[str, Any]]) -> None:
        """Append an episode, its statistics as columns."""
        chunk, file = self._rows.place()
        places = {"meta/episodes/chunk_index": chunk, "meta/episodes/file_index": file}
        numbers = {f"stats/{key}/{name}": value for key, found in stats.items() for name, value in found.items()}
        self._rows.add(pa.Table.from_pylist([{**row, **places, **numbers}]))

    def close(self) -> None:
        """Finish the file that is being written."""
        self._rows.close()


class EpisodesLines:
    """Write ``meta/episodes.jsonl`` and ``meta/episodes_stats.jsonl`` of format v2.1."""

    def __init__(self, root: Path) -> None:
        (root / EPISODES_LINES).parent.mkdir(parents=True, exist_ok=True)
        self._episodes = (root / EPISODES_LINES).open("w", encoding="utf-8")
        self._stats = (root / STATS_LINES).open("w", encoding="utf-8")

    def add(self, row: dict[str, Any], stats: Mapping[str, Mapping[str, Any]]) -> None:
        """Append an episode."""
        self._episodes.write(_line({key: row[key] for key in ("episode_index", "tasks", "length")}))
        self._stats.write(_line({"episode_index": row["episode_index"], "stats": stats}))

    def close(self) -> None:
        """Close both files."""
        self._episodes.close()
        self._stats.close()


def open_episodes(layout: Layout, root: Path, limits: Limits) -> EpisodesWriter:
    """Open what a layout says of episodes."""
    return EpisodesLines(root) if layout.one_file_per_episode else EpisodesTable(root, limits)


def write_tasks(layout: Layout, root: Path, tasks: Sequence[str]) -> None:
    """Write the instructions with their numbers."""
    if layout.one_file_per_episode:
        write_lines(root / TASKS_LINES, ({"task_index": index, "task": task} for index, task in enumerate(tasks)))
    else:
        write_texts(root / TASKS_FILE, "task_index", tasks)


def stage_rows(
    root: Path, index: int, persistent: Sequence[Row], events: Sequence[Sequence[Row]], times: Sequence[float]
) -> None:
    """Write an episode's language rows where ``lerobot-annotate`` looks for the rows of modules that do not run.

    Without them it would remove every row that it has not made itself.

    Args:
        root: folder of the dataset.
        index: of the episode.
        persistent, events: rows of the episode, and of each frame.
        times: of the frames, s, float32 as in the table: LeRobot compares them exactly.
    """
    folder = root / STAGING / f"episode_{index:06d}"
    write_lines(folder / "plan.jsonl", persistent)
    timed = ({**row, "timestamp": time} for rows, time in zip(events, times, strict=True) for row in rows)
    write_lines(folder / "vqa.jsonl", timed)


def write_lines(path: Path, records: Iterable[Mapping[str, Any]]) -> None:
    """Write a file of JSON lines."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", encoding="utf-8") as file:
        file.writelines(map(_line, records))


def _line(record: Mapping[str, Any]) -> str:
    return json.dumps(record, ensure_ascii=False, allow_nan=False) + "\n"
