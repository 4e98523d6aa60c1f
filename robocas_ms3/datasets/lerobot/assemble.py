"""Joins the parts of episodes into the files of a LeRobot dataset: tables one after the other, videos as they are."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from robocas_ms3.datasets.lerobot import schema
from robocas_ms3.datasets.lerobot.schema import Limits
from robocas_ms3.datasets.lerobot.stage import EPISODE_FILE, FRAMES_FILE, SUBGOAL, video_name
from robocas_ms3.datasets.lerobot.stats import Histogram, Levels, Range, vector_stats
from robocas_ms3.datasets.lerobot.tables import RollingTable, column, numbers, write_texts
from robocas_ms3.datasets.lerobot.video import Joiner, packet_times
from robocas_ms3.documents import load_json
from robocas_ms3.errors import DatasetError
from robocas_ms3.files import write_json

_NUMERIC = (*(feature.key for feature in schema.FEATURES), schema.SUBTASK_INDEX.key, *schema.INDICES)
_ROWS = 64  # episodes a row group, of the tables about episodes


def assemble(parts: Sequence[Path], plan: dict[str, Any], fps: int, root: Path, limits: Limits) -> None:
    """Write a dataset from all the parts of a plan.

    Args:
        parts: folder of each.
        plan: content of ``conversion.json``.
        fps: frames a second.
        root: where to write; an empty folder.
        limits: sizes of files.

    Raises:
        DatasetError: a part is damaged.
    """
    reader = _Parts(parts)
    tasks, subgoals, ranges = _survey(reader)
    histograms = {key: Histogram(found.low, found.high) for key, found in ranges.items()}
    levels: dict[str, Levels] = {}
    first = reader.about(0)
    cameras, codec = list(first["cameras"]), plan["settings"]["codec"]
    kinds = ("rgb", "depth") if first["depth"] else ("rgb",)
    with ExitStack() as stack:

        def open_table(pattern: str, **options: Any) -> RollingTable:
            table = RollingTable(partial(schema.data_file, root, pattern), limits.data_mb, **options)
            return stack.enter_context(closing(table))

        data, rows = open_table(schema.DATA_PATH), open_table(schema.EPISODES_PATH, group=_ROWS)
        scenes = RollingTable(lambda *_: root / schema.SCENES_FILE, np.inf, group=_ROWS, compression="zstd")
        stack.enter_context(closing(scenes))
        joiners: dict[tuple[str, str], Joiner] = {}
        for camera in cameras:
            for kind in kinds:
                path: Callable[[int, int], Path] = partial(_video_file, root, kind, camera)
                joiner = Joiner(path, fps, limits.video_mb, limits.video_seconds)
                joiners[kind, camera] = stack.enter_context(closing(joiner))
        start = 0
        for index, entry in enumerate(plan["episodes"]):
            about = reader.about(index)
            columns, types = reader.columns(index, start, tasks, subgoals)
            steps = about["steps"]
            stats = {key: vector_stats(columns[key]) for key in _NUMERIC}
            for key, histogram in histograms.items():
                histogram.add(columns[key])
            for camera, counts in about["levels"].items():
                found = Levels(np.array(counts), steps)
                stats[schema.image_key(camera)] = found.stats()
                levels.setdefault(camera, Levels()).merge(found)
            chunk, file = data.place((parts[index] / FRAMES_FILE).stat().st_size)
            data.add(_data_table(columns, types))
            row = {
                "episode_index": index,
                "tasks": [about["instruction"]],
                "length": steps,
                "dataset_from_index": start,
                "dataset_to_index": start + steps,
                "data/chunk_index": chunk,
                "data/file_index": file,
            }
            for (kind, camera), joiner in joiners.items():
                place = joiner.add(parts[index] / video_name(camera, kind, codec), steps)
                name = f"videos/{schema.image_key(camera)}" if kind == "rgb" else f"depth/{camera}"
                row[f"{name}/chunk_index"], row[f"{name}/file_index"] = place.chunk, place.file
                row[f"{name}/from_timestamp"] = place.first / fps
                row[f"{name}/to_timestamp"] = (place.first + steps) / fps
            row["meta/episodes/chunk_index"], row["meta/episodes/file_index"] = rows.place()
            row |= {f"stats/{key}/{name}": value for key, found in stats.items() for name, value in found.items()}
            rows.add(pa.Table.from_pylist([row]))
            scenes.add(_scene_table(index, entry, about))
            start += steps
    texts = {schema.TASKS_FILE: ("task_index", tasks), schema.SUBTASKS_FILE: ("subtask_index", subgoals)}
    for name, (key, found) in texts.items():
        write_texts(root / name, key, list(found))
    whole = {key: found.stats(histograms[key], key not in _FLOATS) for key, found in ranges.items()}
    whole |= {schema.image_key(camera): found.stats() for camera, found in levels.items()}
    write_json(root / schema.STATS_FILE, whole)
    videos = {camera: packet_times(_video_file(root, "rgb", camera, 0, 0))[1] for camera in cameras}
    robot_type = schema.robot_type(first["scene"])
    write_json(root / schema.INFO_FILE, _info(plan, fps, start, len(tasks), videos, limits, robot_type))
    write_json(root / schema.CONVERSION_FILE, plan)
    sums = {str(path.relative_to(root)): schema.checksum(path) for path in schema.content_files(root)}
    write_json(root / schema.CHECKSUMS_FILE, sums)


_FLOATS = {feature.key for feature in schema.FEATURES} | {"timestamp"}


class _Parts:
    """Reads parts."""

    def __init__(self, folders: Sequence[Path]) -> None:
        self._folders, self.count = folders, len(folders)

    def about(self, index: int) -> dict[str, Any]:
        path = self._folders[index] / EPISODE_FILE
        try:
            return load_json(path)
        except (OSError, ValueError) as error:
            raise DatasetError("this part of a conversion is damaged", where=path, fix="Pass --overwrite.") from error

    def table(self, index: int) -> pa.Table:
        path = self._folders[index] / FRAMES_FILE
        try:
            return pq.read_table(path)
        except (OSError, pa.ArrowException) as error:
            raise DatasetError("this part of a conversion is damaged", where=path, fix="Pass --overwrite.") from error

    def columns(
        self, index: int, start: int, tasks: dict[str, int], subgoals: dict[str, int]
    ) -> tuple[dict[str, NDArray], pa.ChunkedArray]:
        """Numeric features (T, D) with the numbers that follow from the episodes before, and sub-goal types."""
        table = self.table(index)
        columns = {key: numbers(table.column(key)) for key in _NUMERIC if key in table.column_names}
        steps = len(table)
        texts = table.column(SUBGOAL).to_pylist()
        columns[schema.SUBTASK_INDEX.key] = np.array([subgoals[text] for text in texts], np.int64)[:, None]
        columns["episode_index"] = np.full((steps, 1), index, np.int64)
        columns["index"] = np.arange(start, start + steps)[:, None]
        columns["task_index"] = np.full((steps, 1), tasks[self.about(index)["instruction"]], np.int64)
        return columns, table.column(schema.SUBGOAL_TYPE.key)


def _survey(parts: _Parts) -> tuple[dict[str, int], dict[str, int], dict[str, Range]]:
    """Number texts as they come, and find the range of every feature, which histograms need beforehand."""
    tasks: dict[str, int] = {}
    subgoals: dict[str, int] = {}
    ranges = {key: Range() for key in _NUMERIC}
    start = 0
    for index in range(parts.count):
        tasks.setdefault(parts.about(index)["instruction"], len(tasks))
        for text in parts.table(index).column(SUBGOAL).to_pylist():
            subgoals.setdefault(text, len(subgoals))
        columns, _ = parts.columns(index, start, tasks, subgoals)
        for key, found in ranges.items():
            found.add(columns[key])
        start += len(columns["index"])
    return tasks, subgoals, ranges


def _data_table(columns: dict[str, NDArray], types: pa.ChunkedArray) -> pa.Table:
    made: dict[str, Any] = {feature.key: column(columns[feature.key]) for feature in schema.FEATURES}
    made[schema.SUBGOAL_TYPE.key] = types
    for key in (schema.SUBTASK_INDEX.key, *schema.INDICES):
        made[key] = column(columns[key])
    return pa.table(made)


def _scene_table(index: int, entry: dict[str, Any], about: dict[str, Any]) -> pa.Table:
    return pa.table(
        {
            "episode_index": pa.array([index], pa.int64()),
            "scene": pa.array([json.dumps(about["scene"], ensure_ascii=False)], pa.string()),
            "cameras": pa.array([json.dumps(about["cameras"])], pa.string()),
            "source": pa.array([json.dumps(entry, ensure_ascii=False)], pa.string()),
        }
    )


def _video_file(root: Path, kind: str, camera: str, chunk: int, file: int) -> Path:
    if kind == "depth":
        return schema.data_file(root, schema.DEPTH_PATH, chunk, file, camera=camera)
    return schema.data_file(root, schema.VIDEO_PATH, chunk, file, video_key=schema.image_key(camera))


def _info(
    plan: dict[str, Any],
    fps: int,
    frames: int,
    tasks: int,
    videos: dict[str, dict[str, Any]],
    limits: Limits,
    robot_type: str,
) -> dict[str, Any]:
    count = len(plan["episodes"])
    return {
        "codebase_version": schema.CODEBASE_VERSION,
        "robot_type": robot_type,
        "total_episodes": count,
        "total_frames": frames,
        "total_tasks": tasks,
        "chunks_size": schema.CHUNK_FILES,
        "data_files_size_in_mb": limits.data_mb,
        "video_files_size_in_mb": limits.video_mb,
        "fps": fps,
        "splits": {"train": f"0:{count}"},
        "data_path": schema.DATA_PATH,
        "video_path": schema.VIDEO_PATH,
        "features": schema.features_json(videos),
    }
