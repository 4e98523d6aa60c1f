"""Check a LeRobot dataset: totals, lengths, times, videos, texts, statistics and checksums."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from robocas_ms3.core.documents import DocumentError
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.text import one_line
from robocas_ms3.datasets.checks.dataset import ValidationReport
from robocas_ms3.datasets.checks.violation import Violation, check_against_model, read_json_object
from robocas_ms3.datasets.lerobot import schema
from robocas_ms3.datasets.lerobot.check_frames import TOLERANCE, KeyViolation, Ranges, check_data, find_unexpected_files
from robocas_ms3.datasets.lerobot.file_models import MAX_EPISODES, MAX_FRAMES, InfoRecord, StatsLine, read_lines
from robocas_ms3.datasets.lerobot.reader import LeRobotDataset
from robocas_ms3.datasets.lerobot.stats import QUANTILES
from robocas_ms3.datasets.lerobot.video import read_frames, read_packet_times
from robocas_ms3.datasets.sources.file_models import SceneRecord

_MATROSKA_TOLERANCE = 0.6e-3  # s; Matroska rounds to milliseconds
_STATISTICS = ("min", "max", "mean", "std", "count")
_MAX_TOTALS = {"total_episodes": MAX_EPISODES, "total_tasks": MAX_EPISODES, "total_frames": MAX_FRAMES}


def check_lerobot(
    root: str | Path, *, decode: bool = False, on_episode: Callable[[int, int], None] | None = None
) -> ValidationReport:
    """Check a LeRobot dataset and list all violations.

    RoboCAS features are checked only in datasets that have them. ``decode``: decode all video frames, not only count
    them. FFmpeg conceals damage inside a video; the checksums that ``robocas convert`` writes reveal it.
    ``on_episode`` is called with (done, total) after each episode.

    Raises:
        MissingExtraError: the extra ``lerobot`` is not installed.
    """
    schema.require_lerobot()
    root = Path(root)
    info, wrong = read_json_object(root, schema.INFO_FILE, InfoRecord, expected_file="JSON")
    features = {} if wrong else info["features"]
    for declared in schema.FEATURES if set(schema.ROBOCAS_KEYS) <= set(features) else ():
        if (shape := features[declared.key]["shape"]) != [declared.width]:
            wrong.append(
                Violation(schema.INFO_FILE, f"features.{declared.key}.shape", str([declared.width]), str(shape))
            )
    if wrong:
        return ValidationReport(0, 0, wrong)
    try:
        dataset = LeRobotDataset(root)
        wrong = list(_check_totals(dataset))
        texts = {"task_index": dataset.tasks}
        if schema.SUBTASK_INDEX.key in features:
            texts[schema.SUBTASK_INDEX.key] = dataset.subtasks
    except DatasetError as error:
        return ValidationReport(0, 0, [Violation("meta", "", "readable tables", one_line(error))])
    data, ranges = check_data(dataset, texts, on_episode or (lambda *_: None))
    violations = [
        *wrong,
        *data,
        *(wrong for key in dataset.videos for wrong in _check_videos(dataset, key, decode)),
        *_check_statistics(dataset, ranges),
        *_check_robocas_files(dataset),
        *_check_checksums(root),
    ]
    return ValidationReport(len(dataset.rows), dataset.info["total_frames"], violations)


def _check_totals(dataset: LeRobotDataset) -> Iterator[Violation]:
    """Check the totals of ``info.json`` against the tables; then set ``dataset.info`` to the totals found."""
    declared = {key: dataset.info[key] for key in _MAX_TOTALS}
    dataset.info.update(_MAX_TOTALS)  # limits of what is read
    rows, tasks = dataset.rows, dataset.tasks
    start = 0
    for index, row in enumerate(rows):
        end = start + row["length"]
        for key, value in (("episode_index", index), ("dataset_from_index", start), ("dataset_to_index", end)):
            if row[key] != value:
                yield Violation("meta/episodes", f"episode {index}, {key}", str(value), str(row[key]))
        start = end
    for key, found in (("total_episodes", len(rows)), ("total_tasks", len(tasks)), ("total_frames", start)):
        dataset.info[key] = found
        if declared[key] != found:
            yield Violation(schema.INFO_FILE, key, str(found), str(declared[key]))
    if len(set(tasks)) != len(tasks):
        name = schema.TASKS_LINES if dataset.file_layout.one_file_per_episode else schema.TASKS_FILE
        yield Violation(name, "", "each text once", "repeated texts")


def _check_videos(dataset: LeRobotDataset, key: str, decode: bool) -> Iterator[Violation]:
    """Check the video files of a feature, and the separate FFV1 depth files of its camera."""
    root, layout, fps = dataset.root, dataset.file_layout, dataset.info["fps"]
    size, extra = dataset.info["features"][key]["shape"][:2], f"depth/{schema.camera_name(key)}"
    has_extra = any(f"{extra}/file_index" in row for row in dataset.rows)
    for prefix in (f"videos/{key}", extra) if has_extra else (f"videos/{key}",):
        by_file = dataset.rows_by_file(prefix)
        for path, inside in by_file.items():
            yield from _check_times(inside, prefix, fps)
            frames, name = sum(row["length"] for row in inside), str(path.relative_to(root))
            yield from (
                Violation(name, *violation) for violation in _find_video_violations(path, frames, fps, size, decode)
            )
        folder = layout.file_path(root, prefix, 0, 0).parent  # chunk-000, or below it
        chunks = folder.parent.parent.glob(f"*/{folder.name}") if layout.one_file_per_episode else [folder.parent]
        yield from find_unexpected_files(root, chunks, by_file)


def _check_times(rows: list[dict[str, Any]], prefix: str, fps: int) -> Iterator[Violation]:
    first = 0
    for row in rows:
        span = (first / fps, (first + row["length"]) / fps)
        found = (row[f"{prefix}/from_timestamp"], row[f"{prefix}/to_timestamp"])
        if max(abs(a - b) for a, b in zip(span, found, strict=True)) > TOLERANCE:
            where = f"episode {row['episode_index']}, {prefix}"
            yield Violation("meta/episodes", where, f"{span[0]} to {span[1]} s", f"{found[0]} to {found[1]} s")
        first += row["length"]


def _find_video_violations(path: Path, frames: int, fps: int, size: list[int], decode: bool) -> Iterator[KeyViolation]:
    try:
        times, about = read_packet_times(path, frames)
        if decode and len(times) == frames:
            for _ in read_frames(path, 0, frames, fps):
                pass
    except DatasetError as error:
        yield "", "a readable video", str(error)
        return
    if (found := [about["video.height"], about["video.width"]]) != size:
        yield "size", str(size), str(found)
    if len(times) != frames:
        yield "frames", str(frames), str(len(times))
        return
    tolerance = _MATROSKA_TOLERANCE if path.suffix == ".mkv" else TOLERANCE
    late = [index for index, time in enumerate(times) if abs(float(time) - index / fps) > tolerance]
    if late:
        yield f"time of frame {late[0]}", f"{late[0] / fps} s", f"{float(times[late[0]])} s"


def _check_statistics(dataset: LeRobotDataset, ranges: Ranges) -> Iterator[Violation]:
    if dataset.file_layout.one_file_per_episode:
        yield from _check_episode_statistics(dataset)
        if not (dataset.root / schema.STATS_FILE).exists():  # optional in this format
            return
    stats, wrong = read_json_object(dataset.root, schema.STATS_FILE, expected_file="JSON")
    yield from wrong
    for key, feature in dataset.info["features"].items() if not wrong else ():
        if feature["dtype"] not in ("string", "language"):
            for name, expected, found in _find_statistics_violations(stats.get(key), feature, ranges.get(key)):
                yield Violation(schema.STATS_FILE, f"{key}, {name}" if name else key, expected, found)


def _find_statistics_violations(found: Any, feature: Mapping[str, Any], data_range: Any) -> Iterator[KeyViolation]:
    """Yield (name, expected, found) per invalid statistic; ``data_range``: min, max and count in the data."""
    try:
        values = {name: np.asarray(found[name], np.float64) for name in (*_STATISTICS, *QUANTILES)}
    except (LookupError, TypeError, ValueError) as error:
        yield "", f"numbers for {', '.join((*_STATISTICS, *QUANTILES))}", f"{type(error).__name__}: {one_line(error)}"
        return
    shape = (feature["shape"][2], 1, 1) if feature["dtype"] == "video" else tuple(feature["shape"])
    count = values.pop("count")
    for name, array in values.items():
        if array.shape != shape:
            yield name, f"shape {shape}", str(array.shape)
            return
    low, high = values["min"], values["max"]
    slack = 1e-3 * (1 + np.abs(low) + np.abs(high))  # for histograms of other writers, and float32
    for name, array in values.items():
        least, most = (0, high - low + slack) if name == "std" else (low - slack, high + slack)
        if not ((least <= array) & (array <= most)).all():  # NaN too
            yield name, "between min and max", str(array.tolist())[:80]
            return
    if data_range:
        same = np.allclose(low, data_range[0], atol=1e-6) and np.allclose(high, data_range[1], atol=1e-6)
        if not same or count.tolist() != [data_range[2]]:
            expected = f"min {data_range[0].tolist()}, max {data_range[1].tolist()}, count {data_range[2]}"
            yield "", expected, f"min {low.tolist()}, max {high.tolist()}, count {count.tolist()}"


def _check_episode_statistics(dataset: LeRobotDataset) -> Iterator[Violation]:
    features = {key for key, feature in dataset.info["features"].items() if feature["dtype"] not in ("string", "image")}
    try:
        lines = read_lines(dataset.root / schema.STATS_LINES, StatsLine, len(dataset.rows))
    except DatasetError as error:
        yield Violation(schema.STATS_LINES, "", "readable lines", one_line(error))
        return
    if sorted(line.episode_index for line in lines) != sorted(dataset.row_by_episode):
        yield Violation(schema.STATS_LINES, "episode_index", "each episode once", "other episodes")
    for line in lines:
        missing = sorted(key for key in features if not set(line.stats.get(key, {})) >= set(_STATISTICS))
        if missing:
            where = f"episode {line.episode_index}, {missing[0]}"
            yield Violation(schema.STATS_LINES, where, ", ".join(_STATISTICS), "missing statistics")


def _check_robocas_files(dataset: LeRobotDataset) -> Iterator[Violation]:
    """Check split, scenes and cameras in ``meta/robocas``; other LeRobot datasets lack that folder."""
    name, scene_json_texts = schema.SCENES_FILE, {}
    try:
        _ = dataset.split("train"), dataset.split("val")
    except DatasetError as error:
        yield Violation(schema.CONVERSION_FILE, "", "valid content", one_line(error))
    try:
        scene_json_texts = dataset.scene_json_texts
    except DatasetError as error:
        yield Violation(name, "", "valid content", one_line(error))
    if scene_json_texts and scene_json_texts.keys() != dataset.row_by_episode.keys():
        found = sorted(scene_json_texts.keys() ^ dataset.row_by_episode.keys())[:5]
        yield Violation(name, "episode_index", "the episodes of the dataset", f"{found} added or missing")
    for number in sorted(scene_json_texts.keys() & dataset.row_by_episode.keys()):
        try:
            episode = dataset.episode(number)
            yield from check_against_model(SceneRecord, episode.scene, f"{name}, episode {number}")
            for camera in dataset.cameras:
                episode.intrinsic(camera)
        except DatasetError as error:
            yield Violation(name, f"episode {number}", "valid content", one_line(error))


def _check_checksums(root: Path) -> Iterator[Violation]:
    if not (root / schema.CHECKSUMS_FILE).is_file():
        return
    sums, wrong = read_json_object(root, schema.CHECKSUMS_FILE)
    yield from wrong
    for name, expected in sums.items():
        if name.partition("/")[0] not in schema.CONTENT or ".." in Path(name).parts:
            yield Violation(schema.CHECKSUMS_FILE, name, f"a file in {', '.join(schema.CONTENT)}", "another path")
            continue
        try:
            found = schema.compute_checksum(root / name)
        except (OSError, DocumentError) as error:
            found = one_line(error)
        if found != expected:
            yield Violation(name, "", f"the written content, SHA-256 {expected}", found)
