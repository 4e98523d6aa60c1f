"""Join the parts of episodes into the files of a LeRobot dataset: tables one after the other, videos as they are."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from robocas_ms3.core.files import write_json
from robocas_ms3.core.words import count_of
from robocas_ms3.datasets.lerobot import schema
from robocas_ms3.datasets.lerobot.depth import DEPTH_INFO
from robocas_ms3.datasets.lerobot.episodes import GROUP, open_episodes, stage_rows, write_tasks
from robocas_ms3.datasets.lerobot.language import EVENTS
from robocas_ms3.datasets.lerobot.parts import Part, read_parts, survey
from robocas_ms3.datasets.lerobot.schema import Limits
from robocas_ms3.datasets.lerobot.stage import FRAMES_FILE, coding_of, video_name
from robocas_ms3.datasets.lerobot.stats import Histogram, Levels, vector_stats
from robocas_ms3.datasets.lerobot.table_writing import RollingTable, write_texts
from robocas_ms3.datasets.lerobot.variants import CHUNK_FILES, Layout, Variant, find_variant
from robocas_ms3.datasets.lerobot.video import Joiner, packet_times
from robocas_ms3.datasets.sources.protocol import Kind

_log = logging.getLogger(__name__)
_FLOATS = {feature.key for feature in schema.FEATURES} | {"timestamp", schema.REWARD.key}


def assemble(parts: Sequence[Path], plan: dict[str, Any], fps: int, root: Path, limits: Limits) -> None:
    """Write a dataset from all the parts of a plan.

    Args:
        parts: folder of each.
        plan: content of ``conversion.json``.
        fps: frames per second.
        root: where to write; an empty folder.
        limits: sizes of files.

    Raises:
        DatasetError: a part is damaged.
    """
    variant = find_variant(plan["settings"]["lerobot_version"])
    layout, entries = variant.layout, plan["episodes"]
    texts, ranges = survey(read_parts(parts, entries), variant)
    histograms = {key: Histogram(found.low, found.high) for key, found in ranges.items()}
    levels: dict[str, Levels] = {}
    first = next(read_parts(parts[:1], entries[:1])).about
    streams = _streams(variant, first, plan["settings"]["codec"])
    data_mb, video_mb = (0, 0) if layout.one_file_per_episode else (limits.data_mb, limits.video_mb)
    frames = clipped = 0
    with ExitStack() as stack:
        data = RollingTable(partial(layout.path, root, layout.data), data_mb)
        scenes = RollingTable(lambda *_: root / schema.SCENES_FILE, np.inf, group=GROUP, compression="zstd")
        episodes = open_episodes(layout, root, limits)
        for writer in (data, scenes, episodes):
            stack.enter_context(closing(writer))
        joiners = {
            stream.prefix: stack.enter_context(
                closing(Joiner(partial(stream.path, root), fps, video_mb, limits.video_seconds))
            )
            for stream in streams
        }
        for part, entry in zip(read_parts(parts, entries), entries, strict=True):
            about, steps = part.about, part.steps
            columns, persistent = part.columns(variant, texts), part.persistent(fps) if variant.language else []
            stats = {key: vector_stats(values) for key, values in columns.items()}
            for key, histogram in histograms.items():
                histogram.add(columns[key])
            for key, counts in about["levels"].items():
                found = _levels(key, counts, steps)
                stats[key] = found.stats()
                levels.setdefault(key, _levels(key, np.zeros_like(found.counts), 0)).merge(found)
            chunk, file = data.place((part.folder / FRAMES_FILE).stat().st_size)
            data.add(part.data(variant, columns, persistent))
            row = {
                "episode_index": part.index,
                "tasks": [about["instruction"]],
                "length": steps,
                "dataset_from_index": part.start,
                "dataset_to_index": part.start + steps,
                "data/chunk_index": chunk,
                "data/file_index": file,
            }
            for stream in streams:
                place = joiners[stream.prefix].add(part.folder / stream.part_name, steps)
                row[f"{stream.prefix}/chunk_index"], row[f"{stream.prefix}/file_index"] = place.chunk, place.file
                row[f"{stream.prefix}/from_timestamp"] = place.first / fps
                row[f"{stream.prefix}/to_timestamp"] = (place.first + steps) / fps
            episodes.add(row, stats)
            scenes.add(_scene_table(part, entry))
            if variant.language:
                events, times = part.table.column(EVENTS).to_pylist(), columns["timestamp"][:, 0].tolist()
                stage_rows(root, part.index, persistent, events, times)
            frames += steps
            clipped += bool(about.get("depth_clipped"))
    if clipped:
        limit = schema.MAX_DEPTH_MM
        _log.warning("%s: depth above %d mm is stored as %d mm", count_of(clipped, "episode"), limit, limit)
    write_tasks(layout, root, list(texts.tasks))
    if not variant.language:
        write_texts(root / schema.SUBTASKS_FILE, schema.SUBTASK_INDEX.key, list(texts.subgoals))
    if layout.one_file_per_episode:
        write_json(root / schema.MODALITY_FILE, schema.modality_json(list(first["cameras"])))
    whole = {key: found.stats(histograms[key], key not in _FLOATS) for key, found in ranges.items()}
    write_json(root / schema.STATS_FILE, whole | {key: found.stats() for key, found in levels.items()})
    totals = {"total_episodes": len(entries), "total_frames": frames, "total_tasks": len(texts.tasks)}
    videos = {stream.key: stream.describe(root, variant) for stream in streams if stream.key}
    write_json(root / schema.INFO_FILE, _info(variant, fps, totals, videos, limits, schema.robot_type(first["scene"])))
    write_json(root / schema.CONVERSION_FILE, plan)
    sums = {str(path.relative_to(root)): schema.checksum(path) for path in schema.content_files(root)}
    write_json(root / schema.CHECKSUMS_FILE, sums)


@dataclass(frozen=True)
class _Stream:
    """The videos of a camera.

    Attributes:
        kind: of images.
        key: of the feature; empty: LeRobot does not read these videos.
        prefix: of the columns of ``meta/episodes``.
        part_name: of the video of a part.
        path: of a numbered file: (root, chunk, file) -> path.
    """

    kind: Kind
    key: str
    prefix: str
    part_name: str
    path: Callable[[Path, int, int], Path]

    def describe(self, root: Path, variant: Variant) -> dict[str, Any]:
        """Return ``info`` of the feature."""
        marked = (
            DEPTH_INFO if self.kind == "depth" else {f"{'' if variant.native_depth else 'video.'}is_depth_map": False}
        )
        return {**packet_times(self.path(root, 0, 0))[1], **marked}


def _streams(variant: Variant, about: dict[str, Any], codec: str) -> list[_Stream]:
    """Return the streams of a dataset, by the description of a part."""
    layout, streams = variant.layout, []
    kinds: tuple[Kind, ...] = ("rgb", "depth") if about["depth"] else ("rgb",)
    for camera in about["cameras"]:
        for kind in kinds:
            name = video_name(camera, kind, coding_of(kind, codec, variant))
            if kind == "rgb" or variant.native_depth:
                key = schema.image_key(camera) if kind == "rgb" else schema.depth_key(camera)
                streams.append(_Stream(kind, key, f"videos/{key}", name, _path_of(layout, layout.video, video_key=key)))
            else:
                streams.append(
                    _Stream(kind, "", f"depth/{camera}", name, _path_of(layout, layout.depth, camera=camera))
                )
    return streams


def _path_of(layout: Layout, pattern: str, **names: str) -> Callable[[Path, int, int], Path]:
    return lambda root, chunk, file: layout.path(root, pattern, chunk, file, **names)


def _levels(key: str, counts: Any, pictures: int) -> Levels:
    """Return counts of a video's levels; those of depth stand for mm."""
    counts = np.array(counts, np.int64)
    return Levels(counts, pictures, 1.0 if len(counts) == 1 else 1 / 255)


def _scene_table(part: Part, entry: dict[str, Any]) -> pa.Table:
    return pa.table(
        {
            "episode_index": pa.array([part.index], pa.int64()),
            "scene": pa.array([json.dumps(part.about["scene"], ensure_ascii=False)], pa.string()),
            "cameras": pa.array([json.dumps(part.about["cameras"])], pa.string()),
            "source": pa.array([json.dumps(entry, ensure_ascii=False)], pa.string()),
        }
    )


def _info(
    variant: Variant,
    fps: int,
    totals: dict[str, int],
    videos: dict[str, dict[str, Any]],
    limits: Limits,
    robot_type: str,
) -> dict[str, Any]:
    layout, count = variant.layout, totals["total_episodes"]
    if layout.one_file_per_episode:
        files = {"total_videos": count * len(videos), "total_chunks": -(-count // CHUNK_FILES)}
    else:
        files = {"data_files_size_in_mb": limits.data_mb, "video_files_size_in_mb": limits.video_mb}
    return {
        "codebase_version": layout.codebase_version,
        "robot_type": robot_type,
        **totals,
        "chunks_size": CHUNK_FILES,
        **files,
        "fps": fps,
        "splits": {"train": f"0:{count}"},
        "data_path": layout.data,
        "video_path": layout.video,
        "features": schema.features_json(variant, videos),
    }
