"""Checks the videos of a LeRobot dataset: each holds the frames that the tables say, at their times, undamaged."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets.checks.violation import Violation
from robocas_ms3.datasets.lerobot import schema
from robocas_ms3.datasets.lerobot.reader import LeRobotDataset
from robocas_ms3.datasets.lerobot.variants import Layout
from robocas_ms3.datasets.lerobot.video import packet_times, read_frames

TOLERANCE = 1e-4
"""Of times, s: what LeRobot tolerates."""
_MILLISECONDS = 0.6e-3  # Matroska rounds to them


def check_videos(dataset: LeRobotDataset, key: str, decode: bool) -> Iterator[Violation]:
    """Check the videos of a feature, and the camera's depth videos that LeRobot does not read, where there are any.

    Args:
        dataset: it is in.
        key: of the feature.
        decode: whether to decode the frames, or to count them only.
    """
    root, layout, info, rows = dataset.root, dataset.layout, dataset.info, dataset.rows
    camera, feature = schema.camera_of(key), info["features"][key]
    kinds = [(f"videos/{key}", layout.video)]
    if rows and f"depth/{camera}/file_index" in rows[0]:
        kinds.append((f"depth/{camera}", layout.depth))
    for prefix, pattern in kinds:
        by_file: dict[Path, list[dict[str, Any]]] = defaultdict(list)
        for row in rows:
            place = row[f"{prefix}/chunk_index"], row[f"{prefix}/file_index"]
            by_file[layout.path(root, pattern, *place, video_key=key, camera=camera)].append(row)
        for path, inside in by_file.items():
            yield from _times(inside, prefix, info["fps"])
            frames = sum(row["length"] for row in inside)
            yield from _video(path, str(path.relative_to(root)), frames, info["fps"], feature["shape"], decode)
        for path in _files_of(root, layout, pattern, key, camera):
            if path not in by_file:
                yield Violation(str(path.relative_to(root)), "", "files of episodes only", "of none")


def _files_of(root: Path, layout: Layout, pattern: str, key: str, camera: str) -> list[Path]:
    """Return the files in the folders of a feature's videos."""
    folder = layout.path(root, pattern, 0, 0, video_key=key, camera=camera).parent  # chunk-000, or below it
    chunks = folder.parent.parent.glob(f"*/{folder.name}") if layout.one_file_per_episode else [folder.parent]
    return sorted(path for chunk in chunks for path in chunk.rglob("*") if path.is_file())


def _times(rows: list[dict[str, Any]], prefix: str, fps: int) -> Iterator[Violation]:
    """Episodes of one file follow each other from its beginning on."""
    first = 0
    for row in rows:
        span = (first / fps, (first + row["length"]) / fps)
        found = (row[f"{prefix}/from_timestamp"], row[f"{prefix}/to_timestamp"])
        if max(abs(a - b) for a, b in zip(span, found, strict=True)) > TOLERANCE:
            where = f"episode {row['episode_index']}, {prefix}"
            yield Violation("meta/episodes", where, f"{span[0]} to {span[1]} s", f"{found[0]} to {found[1]} s")
        first += row["length"]


def _video(path: Path, name: str, frames: int, fps: int, shape: list[int], decode: bool) -> Iterator[Violation]:
    try:
        times, about = packet_times(path, frames)
    except DatasetError as error:
        yield Violation(name, "", "a readable video", str(error))
        return
    size = [about["video.height"], about["video.width"]]
    if size != list(shape[:2]):
        yield Violation(name, "size", str(list(shape[:2])), str(size))
    if len(times) != frames:
        yield Violation(name, "frames", str(frames), str(len(times)))
        return
    tolerance = _MILLISECONDS if path.suffix == ".mkv" else TOLERANCE
    late = [index for index, time in enumerate(times) if abs(float(time) - index / fps) > tolerance]
    if late:
        yield Violation(name, f"time of frame {late[0]}", f"{late[0] / fps} s", f"{float(times[late[0]])} s")
    elif decode:
        try:
            for _ in read_frames(path, 0, frames, fps):
                pass
        except DatasetError as error:
            yield Violation(name, "", "whole frames", str(error))
