"""Writes a LeRobot dataset from the parts of its episodes: tables and videos one after the other, not encoded again."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from robocas_ms3.core.files import write_json
from robocas_ms3.core.words import count_of
from robocas_ms3.datasets.lerobot import schema
from robocas_ms3.datasets.lerobot.depth import DEPTH_INFO
from robocas_ms3.datasets.lerobot.language import EVENTS, Row
from robocas_ms3.datasets.lerobot.parts import FRAMES_FILE, SUBGOAL, Part, numeric_keys, read_parts, video_name
from robocas_ms3.datasets.lerobot.schema import FileLimits
from robocas_ms3.datasets.lerobot.stats import Histogram, Levels, Range, Stats, vector_stats
from robocas_ms3.datasets.lerobot.tables import write_texts
from robocas_ms3.datasets.lerobot.variants import CHUNK_FILES, Variant, find_variant
from robocas_ms3.datasets.lerobot.video import Joiner, packet_times
from robocas_ms3.datasets.sources.protocol import Kind

_GROUP = 64  # episodes per row group of the tables about episodes
_FLOATS = {*schema.OUR_KEYS, "timestamp", schema.REWARD.key}
_log = logging.getLogger(__name__)


def join_parts(folders: Sequence[Path], plan: Mapping[str, Any], root: Path, limits: FileLimits) -> None:
    """Write a dataset from all parts of a plan.

    Args:
        folders: of the parts.
        plan: content of ``conversion.json``.
        root: an empty folder.
        limits: of the sizes of files.
    """
    writer = LeRobotWriter(root, plan, limits)
    for part in read_parts(folders, plan["episodes"]):
        writer.survey(part)
    with writer:
        for part, entry in zip(read_parts(folders, plan["episodes"]), plan["episodes"], strict=True):
            writer.add_episode(part, entry)
    writer.finalize()


class LeRobotWriter:
    """Writes episodes, and at the end what ``meta`` says of all of them.

    Every part is surveyed before the first is added: texts are numbered, and histograms need the range of each feature.
    """

    def __init__(self, root: Path, plan: Mapping[str, Any], limits: FileLimits) -> None:
        self._root, self._plan, self._limits = root, plan, limits
        self._variant: Variant = find_variant(plan["settings"]["lerobot_version"])
        self._layout, self._fps = self._variant.layout, int(plan["settings"]["rate_hz"])
        self._first: Part | None = None
        self._tasks: dict[str, int] = {}
        self._subgoals: dict[str, int] = {}
        self._ranges = {key: Range() for key in numeric_keys(self._variant)}
        self._levels: dict[str, Levels] = {}
        self._frames = self._clipped = 0
        self._stack = ExitStack()

    def survey(self, part: Part) -> None:
        """Number the texts of a part, and extend the ranges of the features."""
        self._first = self._first or part
        self._tasks.setdefault(part.record.instruction, len(self._tasks))
        for text in part.table.column(SUBGOAL).to_pylist():
            self._subgoals.setdefault(text, len(self._subgoals))
        for key, values in part.columns(self._variant, self._tasks, self._subgoals).items():
            self._ranges[key].add(values)

    def __enter__(self) -> LeRobotWriter:
        layout, root, limits = self._layout, self._root, self._limits
        data_mb, video_mb = (0, 0) if layout.one_file_per_episode else (limits.data_mb, limits.video_mb)
        self._histograms = {key: Histogram(found.low, found.high) for key, found in self._ranges.items()}
        self._data = RollingTable(partial(layout.path, root, layout.data), data_mb)
        self._scenes = RollingTable(lambda *_: root / schema.SCENES_FILE, np.inf, group=_GROUP, compression="zstd")
        self._episodes = (
            _EpisodesLines(root)
            if layout.one_file_per_episode
            else _EpisodesTable(partial(layout.path, root, schema.EPISODES_PATH), limits.data_mb)
        )
        self._streams = list(self._open_streams(video_mb))
        joiners = [stream.joiner for stream in self._streams]
        for writer in (self._data, self._scenes, self._episodes, *joiners):
            self._stack.enter_context(closing(writer))
        return self

    def __exit__(self, *error: Any) -> None:
        self._stack.__exit__(*error)

    def _open_streams(self, limit_mb: float) -> Iterable[_Stream]:
        assert self._first is not None
        layout, variant, codec = self._layout, self._variant, self._plan["settings"]["codec"]
        kinds: tuple[Kind, ...] = ("rgb", "depth") if self._first.record.depth else ("rgb",)
        for camera in self._first.record.cameras:
            for kind in kinds:
                if kind == "rgb" or variant.native_depth:
                    key = schema.image_key(camera) if kind == "rgb" else schema.depth_key(camera)
                    path, prefix = partial(layout.path, self._root, layout.video, video_key=key), f"videos/{key}"
                else:
                    key, path = "", partial(layout.path, self._root, layout.depth, camera=camera)
                    prefix = f"depth/{camera}"
                joiner = Joiner(path, self._fps, limit_mb, self._limits.video_seconds)
                yield _Stream(kind, key, prefix, video_name(camera, kind, codec, variant), joiner, path)

    def add_episode(self, part: Part, entry: Mapping[str, Any]) -> None:
        """Append an episode.

        Args:
            part: of the episode.
            entry: its entry in ``conversion.json``.
        """
        record, steps, variant, fps = part.record, len(part.table), self._variant, self._fps
        columns = part.columns(variant, self._tasks, self._subgoals)
        persistent = part.persistent(fps) if variant.language else []
        stats = {key: vector_stats(values) for key, values in columns.items()}
        for key, histogram in self._histograms.items():
            histogram.add(columns[key])
        for key, counts in record.levels.items():
            levels = Levels(counts, steps)
            stats[key] = levels.stats()
            self._levels.setdefault(key, Levels(np.zeros_like(counts))).merge(levels)
        chunk, file = self._data.place((part.folder / FRAMES_FILE).stat().st_size)
        self._data.add(part.data(variant, columns, persistent))
        row = {
            "episode_index": part.index,
            "tasks": [record.instruction],
            "length": steps,
            "dataset_from_index": part.start,
            "dataset_to_index": part.start + steps,
            "data/chunk_index": chunk,
            "data/file_index": file,
        }
        for stream in self._streams:
            chunk, file, first = stream.joiner.add(part.folder / stream.part_name, steps)
            row[f"{stream.prefix}/chunk_index"], row[f"{stream.prefix}/file_index"] = chunk, file
            row[f"{stream.prefix}/from_timestamp"] = first / fps
            row[f"{stream.prefix}/to_timestamp"] = (first + steps) / fps
        self._episodes.add(row, stats)
        cameras = {name: camera.model_dump(exclude_none=True) for name, camera in record.cameras.items()}
        texts = {
            "scene": json.dumps(record.scene, ensure_ascii=False),
            "cameras": json.dumps(cameras),
            "source": json.dumps(entry, ensure_ascii=False),
        }
        self._scenes.add(
            pa.table({"episode_index": [part.index], **{key: pa.array([text]) for key, text in texts.items()}})
        )
        if variant.language:
            events, times = part.table.column(EVENTS).to_pylist(), columns["timestamp"][:, 0].tolist()
            self._stage_rows(part.index, persistent, events, times)
        self._frames += steps
        self._clipped += record.depth_clipped

    def _stage_rows(self, index: int, persistent: list[Row], events: list[list[Row]], times: list[float]) -> None:
        """Write language rows where ``lerobot-annotate`` looks for rows to keep; it removes all others.

        Args:
            index: of the episode.
            persistent, events: rows of the episode, and of each frame.
            times: of the frames, s, float32 as in the table: LeRobot compares them exactly.
        """
        folder = self._root / schema.STAGING / f"episode_{index:06d}"
        timed = ({**row, "timestamp": time} for rows, time in zip(events, times, strict=True) for row in rows)
        for name, rows in (("plan", persistent), ("vqa", timed)):
            _write_lines(folder / f"{name}.jsonl", rows)

    def finalize(self) -> None:
        """Write texts, statistics, ``info.json``, ``conversion.json`` and checksums."""
        assert self._first is not None
        root, layout, record = self._root, self._layout, self._first.record
        if self._clipped:
            limit = schema.MAX_DEPTH_MM
            _log.warning("%s: depth above %d mm is stored as %d mm", count_of(self._clipped, "episode"), limit, limit)
        if layout.one_file_per_episode:
            tasks = ({"task_index": index, "task": task} for task, index in self._tasks.items())
            _write_lines(root / schema.TASKS_LINES, tasks)
            write_json(root / schema.MODALITY_FILE, schema.modality_json(list(record.cameras)))
        else:
            write_texts(root / schema.TASKS_FILE, "task_index", list(self._tasks))
        if not self._variant.language:
            write_texts(root / schema.SUBTASKS_FILE, schema.SUBTASK_INDEX.key, list(self._subgoals))
        stats = {key: found.stats(self._histograms[key], key not in _FLOATS) for key, found in self._ranges.items()}
        write_json(root / schema.STATS_FILE, stats | {key: found.stats() for key, found in self._levels.items()})
        write_json(root / schema.INFO_FILE, self._info(schema.robot_type(record.scene)))
        write_json(root / schema.CONVERSION_FILE, self._plan)
        sums = {str(path.relative_to(root)): schema.checksum(path) for path in schema.content_files(root)}
        write_json(root / schema.CHECKSUMS_FILE, sums)

    def _info(self, robot_type: str) -> dict[str, Any]:
        layout, limits, count = self._layout, self._limits, len(self._plan["episodes"])
        videos = {stream.key: self._describe(stream) for stream in self._streams if stream.key}
        if layout.one_file_per_episode:
            files = {"total_videos": count * len(videos), "total_chunks": -(-count // CHUNK_FILES)}
        else:
            files = {"data_files_size_in_mb": limits.data_mb, "video_files_size_in_mb": limits.video_mb}
        return {
            "codebase_version": layout.codebase_version,
            "robot_type": robot_type,
            "total_episodes": count,
            "total_frames": self._frames,
            "total_tasks": len(self._tasks),
            "chunks_size": CHUNK_FILES,
            **files,
            "fps": self._fps,
            "splits": {"train": f"0:{count}"},
            "data_path": layout.data,
            "video_path": layout.video,
            "features": schema.features_json(self._variant, videos),
        }

    def _describe(self, stream: _Stream) -> dict[str, Any]:
        """Return ``info`` of the feature of a video."""
        mark = "is_depth_map" if self._variant.native_depth else "video.is_depth_map"
        return {**packet_times(stream.path(0, 0))[1], **(DEPTH_INFO if stream.kind == "depth" else {mark: False})}


@dataclass(frozen=True)
class _Stream:
    """The videos of a camera.

    Attributes:
        kind: of images.
        key: of the feature; empty: LeRobot does not read these videos.
        prefix: of the columns of ``meta/episodes``.
        part_name: of the video of a part.
        joiner: writes them.
        path: of a numbered file: (chunk, file) -> path.
    """

    kind: Kind
    key: str
    prefix: str
    part_name: str
    joiner: Joiner
    path: Callable[[int, int], Path]


class RollingTable:
    """Writes a table to numbered files, row group by row group.

    Args:
        path: of a file, from chunk and file number.
        limit_mb: size a file may have, 2^20 bytes; 0: each added table has a file of its own.
        group: number of tables that are written together.
        compression: of columns.
    """

    def __init__(
        self, path: Callable[[int, int], Path], limit_mb: float, group: int = 1, compression: str = "snappy"
    ) -> None:
        self._path, self._limit, self._group, self._compression = path, limit_mb * 2**20, group, compression
        self._count = 0
        self._waiting: list[pa.Table] = []
        self._file: Any = None
        self._writer: pq.ParquetWriter | None = None
        self._schema: pa.Schema | None = None

    def place(self, size: int = 0) -> tuple[int, int]:
        """Return chunk and file number for the next rows, of about ``size`` bytes."""
        if self._file is not None and self._file.tell() + size > self._limit and self._file.tell() > 4:  # its head
            self.close()
        number = self._count if self._file is None else self._count - 1
        return divmod(number, CHUNK_FILES)

    def add(self, table: pa.Table) -> None:
        """Append rows to the file that `place` returned."""
        if self._file is None:
            path = self._path(*divmod(self._count, CHUNK_FILES))
            path.parent.mkdir(parents=True, exist_ok=True)
            self._schema = self._schema or table.schema
            self._file = path.open("wb")
            self._writer = pq.ParquetWriter(self._file, self._schema, compression=self._compression)
            self._count += 1
        self._waiting.append(table.cast(self._schema))
        if len(self._waiting) >= self._group:
            self._flush()

    def close(self) -> None:
        """Finish the file that is being written."""
        if self._writer is not None:
            self._flush()
            self._writer.close()
            self._file.close()
            self._writer = self._file = None

    def _flush(self) -> None:
        if self._waiting:
            assert self._writer is not None
            self._writer.write_table(pa.concat_tables(self._waiting).combine_chunks())
            self._waiting.clear()


class _EpisodesTable:
    """``meta/episodes`` of format v3.0; statistics are columns."""

    def __init__(self, path: Callable[[int, int], Path], limit_mb: float) -> None:
        self._rows = RollingTable(path, limit_mb, group=_GROUP)

    def add(self, row: dict[str, Any], stats: Mapping[str, Stats]) -> None:
        chunk, file = self._rows.place()
        places = {"meta/episodes/chunk_index": chunk, "meta/episodes/file_index": file}
        numbers = {f"stats/{key}/{name}": value for key, found in stats.items() for name, value in found.items()}
        self._rows.add(pa.Table.from_pylist([{**row, **places, **numbers}]))

    def close(self) -> None:
        self._rows.close()


class _EpisodesLines:
    """``meta/episodes.jsonl`` and ``meta/episodes_stats.jsonl`` of format v2.1."""

    def __init__(self, root: Path) -> None:
        (root / schema.EPISODES_LINES).parent.mkdir(parents=True, exist_ok=True)
        self._episodes = (root / schema.EPISODES_LINES).open("w", encoding="utf-8")
        self._stats = (root / schema.STATS_LINES).open("w", encoding="utf-8")

    def add(self, row: dict[str, Any], stats: Mapping[str, Stats]) -> None:
        self._episodes.write(_line({key: row[key] for key in ("episode_index", "tasks", "length")}))
        self._stats.write(_line({"episode_index": row["episode_index"], "stats": stats}))

    def close(self) -> None:
        self._episodes.close()
        self._stats.close()


def _write_lines(path: Path, records: Iterable[Mapping[str, Any]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", encoding="utf-8") as file:
        file.writelines(map(_line, records))


def _line(record: Mapping[str, Any]) -> str:
    return json.dumps(record, ensure_ascii=False, allow_nan=False) + "\n"
