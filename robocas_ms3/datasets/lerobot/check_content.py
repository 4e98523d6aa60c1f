"""Checks the videos and the statistics of a LeRobot dataset against its tables."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.words import one_line
from robocas_ms3.datasets.checks.violation import Violation, read_object
from robocas_ms3.datasets.lerobot import schema
from robocas_ms3.datasets.lerobot.check_frames import TOLERANCE, Ranges
from robocas_ms3.datasets.lerobot.reader import LeRobotDataset
from robocas_ms3.datasets.lerobot.records import StatsLine, read_lines
from robocas_ms3.datasets.lerobot.stats import QUANTILES
from robocas_ms3.datasets.lerobot.video import packet_times, read_frames

_MILLISECONDS = 0.6e-3  # Matroska rounds to them
_STATISTICS = {"min", "max", "mean", "std", "count"}


def check_videos(dataset: LeRobotDataset, key: str, decode: bool) -> Iterator[Violation]:
    """Check the videos of a feature, and the depth videos of the camera that LeRobot does not read.

    Args:
        dataset: it is in.
        key: of the feature.
        decode: decode the frames, instead of counting them.
    """
    root, layout, info, rows = dataset.root, dataset.layout, dataset.info, dataset.rows
    camera, shape = schema.camera_of(key), info["features"][key]["shape"]
    prefixes = [f"videos/{key}"]
    if rows and f"depth/{camera}/file_index" in rows[0]:
        prefixes.append(f"depth/{camera}")
    for prefix in prefixes:
        by_file: dict[Path, list[dict[str, Any]]] = defaultdict(list)
        for row in rows:
            by_file[layout.path_of(root, prefix, row)].append(row)
        for path, inside in by_file.items():
            yield from _check_times(inside, prefix, info["fps"])
            frames, name = sum(row["length"] for row in inside), str(path.relative_to(root))
            yield from (Violation(name, *fault) for fault in _video_faults(path, frames, info["fps"], shape, decode))
        folder = layout.path(root, prefix, 0, 0).parent  # chunk-000, or below it
        chunks = folder.parent.parent.glob(f"*/{folder.name}") if layout.one_file_per_episode else [folder.parent]
        for path in sorted(path for chunk in chunks for path in chunk.rglob("*") if path.is_file()):
            if path not in by_file:
                yield Violation(str(path.relative_to(root)), "", "files of episodes only", "of none")


def _check_times(rows: list[dict[str, Any]], prefix: str, fps: int) -> Iterator[Violation]:
    """Check that the episodes of a file follow each other."""
    first = 0
    for row in rows:
        span = (first / fps, (first + row["length"]) / fps)
        found = (row[f"{prefix}/from_timestamp"], row[f"{prefix}/to_timestamp"])
        if max(abs(a - b) for a, b in zip(span, found, strict=True)) > TOLERANCE:
            where = f"episode {row['episode_index']}, {prefix}"
            yield Violation("meta/episodes", where, f"{span[0]} to {span[1]} s", f"{found[0]} to {found[1]} s")
        first += row["length"]


def _video_faults(path: Path, frames: int, fps: int, shape: list[int], decode: bool) -> Iterator[tuple[str, str, str]]:
    try:
        times, about = packet_times(path, frames)
    except DatasetError as error:
        yield "", "a readable video", str(error)
        return
    size = [about["video.height"], about["video.width"]]
    if size != list(shape[:2]):
        yield "size", str(list(shape[:2])), str(size)
    if len(times) != frames:
        yield "frames", str(frames), str(len(times))
        return
    tolerance = _MILLISECONDS if path.suffix == ".mkv" else TOLERANCE
    late = [index for index, time in enumerate(times) if abs(float(time) - index / fps) > tolerance]
    if late:
        yield f"time of frame {late[0]}", f"{late[0] / fps} s", f"{float(times[late[0]])} s"
    elif decode:
        try:
            for _ in read_frames(path, 0, frames, fps):
                pass
        except DatasetError as error:
            yield "", "whole frames", str(error)


def check_statistics(dataset: LeRobotDataset, ranges: Ranges) -> Iterator[Violation]:
    """Check that there are statistics of every feature, with the ranges of the data."""
    if dataset.layout.one_file_per_episode:
        yield from _check_lines(dataset)
        if not (dataset.root / schema.STATS_FILE).exists():  # of an older format, and optional
            return
    stats, wrong = read_object(dataset.root, schema.STATS_FILE, absent="JSON")
    if wrong:
        yield from wrong
        return
    for key, feature in dataset.info["features"].items():
        if feature["dtype"] not in ("string", "language"):
            for name, expected, found in _faults(stats.get(key, {}), feature, ranges.get(key)):
                yield Violation(schema.STATS_FILE, f"{key}, {name}" if name else key, expected, found)


def _faults(found: Any, feature: Mapping[str, Any], seen: Any) -> Iterator[tuple[str, str, str]]:
    """Yield name, expected and found of wrong statistics of a feature; ``seen`` is its entry in the ranges."""
    if not isinstance(found, dict):
        yield "", "an object", type(found).__name__
        return
    missing = {*_STATISTICS, *QUANTILES} - set(found)
    if missing:
        yield "", ", ".join(sorted(missing)), "nothing"
        return
    shape = (feature["shape"][2], 1, 1) if feature["dtype"] == "video" else tuple(feature["shape"])
    shapes = {name: _shape_of(value) for name, value in found.items() if name != "count"}
    wrong = next((name for name in shapes if shapes[name] != shape), None)
    if wrong:
        yield wrong, f"shape {shape}", f"{shapes[wrong]}"
    elif outside := _outside(found):
        yield outside, "between min and max", str(found[outside])[:80]
    elif seen:
        low, high, count = seen
        same = np.allclose(found["min"], low, atol=1e-6) and np.allclose(found["max"], high, atol=1e-6)
        if not same or found["count"] != [count]:
            expected = f"min {low.tolist()}, max {high.tolist()}, count {count}"
            yield "", expected, f"min {found['min']}, max {found['max']}, count {found['count']}"


def _shape_of(value: Any) -> tuple[int, ...] | str:
    try:
        array = np.asarray(value)
    except ValueError:  # lists of different lengths
        return "no numbers"
    return array.shape if array.dtype.kind in "iuf" else "no numbers"


def _outside(found: Mapping[str, Any]) -> str | None:
    """Return the first statistic of a feature that is outside of the range, or None."""
    low, high = (np.asarray(found[name], np.float64) for name in ("min", "max"))
    slack = 1e-3 * (1 + np.abs(low) + np.abs(high))  # of histograms and float32
    bounds = {name: (low - slack, high + slack) for name in ("mean", *QUANTILES)} | {"std": (0, high - low + slack)}
    return next(
        (k for k, (a, b) in bounds.items() if not ((a <= np.array(found[k])) & (np.array(found[k]) <= b)).all()), None
    )


def _check_lines(dataset: LeRobotDataset) -> Iterator[Violation]:
    """Check that each episode has statistics of every feature."""
    features = {key for key, feature in dataset.info["features"].items() if feature["dtype"] not in ("string", "image")}
    try:
        lines = read_lines(dataset.root / schema.STATS_LINES, StatsLine, len(dataset.rows))
    except DatasetError as error:
        yield Violation(schema.STATS_LINES, "", "readable lines", one_line(error))
        return
    if sorted(line.episode_index for line in lines) != sorted(dataset.row_of):
        yield Violation(schema.STATS_LINES, "episode_index", "each episode once", "others")
    for line in lines:
        missing = sorted(key for key in features if not set(line.stats.get(key, {})) >= _STATISTICS)
        if missing:
            where = f"episode {line.episode_index}, {missing[0]}"
            yield Violation(schema.STATS_LINES, where, ", ".join(sorted(_STATISTICS)), "some are missing")
