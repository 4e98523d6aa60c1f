"""Checks a LeRobot dataset against its own declarations: lengths, numbers, times, videos, texts, statistics."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocas_ms3.datasets.checks import arrays as laws
from robocas_ms3.datasets.checks.content import read_object
from robocas_ms3.datasets.checks.dataset import Report
from robocas_ms3.datasets.checks.scene_values import check_form, check_values
from robocas_ms3.datasets.checks.violation import Violation
from robocas_ms3.datasets.lerobot import schema
from robocas_ms3.datasets.lerobot.check_videos import TOLERANCE, check_videos
from robocas_ms3.datasets.lerobot.reader import LeRobotDataset
from robocas_ms3.datasets.lerobot.records import (
    MAX_EPISODES,
    MAX_FRAMES,
    ConversionRecord,
    InfoRecord,
    episode_columns,
    frame_columns,
    unknown_numbers,
    wrong_shapes,
)
from robocas_ms3.datasets.lerobot.stats import QUANTILES, shape_of
from robocas_ms3.datasets.lerobot.tables import faults, numbers, open_table, read_rows
from robocas_ms3.datasets.sources.tolerant import EpisodeArrays, first_line
from robocas_ms3.documents import DocumentError
from robocas_ms3.errors import DatasetError
from robocas_ms3.words import count_of

Ranges = Mapping[str, tuple[NDArray, NDArray, int]]
"""Feature -> least and greatest of each of its numbers, and how many frames."""
Texts = Mapping[str, list[str]]
"""Index feature -> texts that it is of."""


@dataclass(frozen=True)
class Frames:
    """An episode's frames: where they are, its row, numeric features (T, D) and types of sub-goals (T,) or none."""

    file: str
    row: Mapping[str, Any]
    count: int
    columns: Mapping[str, NDArray]
    types: list[Any]

    def violation(self, key: str, expected: object, found: object) -> Violation:
        """One of this episode."""
        where = f"episode {self.row['episode_index']}"
        return Violation(self.file, f"{where}, {key}" if key else where, str(expected), str(found))


def is_lerobot(root: Path) -> bool:
    """Whether a folder holds a LeRobot dataset, whole or not."""
    return (root / schema.INFO_FILE).is_file()


def check_lerobot(
    root: str | Path, *, decode: bool = False, on_episode: Callable[[int, int], None] | None = None
) -> list[Violation]:
    """Check a dataset; datasets made elsewhere are checked as far as they have what ours have.

    Args:
        root: the dataset.
        decode: decode every frame too; without, frames are counted. Damage inside a video shows by the checksums, which
            datasets made elsewhere lack; FFmpeg's decoders conceal it.
        on_episode: called with the number of episodes done and of all.

    Returns:
        What is wrong; empty for a valid dataset.

    Raises:
        MissingExtraError: the ``lerobot`` extra is not installed.
    """
    schema.require_extra()
    root = Path(root)
    info = read_object(root, schema.INFO_FILE, absent="JSON")
    wrong = [info.wrong] if info.wrong else list(_check_info(info.content))
    if wrong:
        return wrong
    try:
        dataset = LeRobotDataset(root)
        totals = list(_check_counts(dataset))
        wrong = list(_check_rows(dataset))
        if wrong:
            return [*totals, *wrong]
        totals += _check_totals(dataset)
        subtasks = dataset.subtasks if schema.SUBTASK_INDEX.key in dataset.info["features"] else []
        texts = {"task_index": dataset.tasks, schema.SUBTASK_INDEX.key: subtasks}
    except DatasetError as error:
        return [_violation("meta", "readable tables", error)]
    data, ranges = _check_data(dataset, texts, on_episode or (lambda *_: None))
    videos = [key for key, feature in dataset.info["features"].items() if feature["dtype"] == "video"]
    return [
        *totals,
        *data,
        *(wrong for key in videos for wrong in check_videos(dataset, key, decode)),
        *_check_statistics(dataset, ranges),
        *_check_conversion(dataset),
        *_check_scenes(dataset),
        *_check_checksums(root),
    ]


def _violation(file: str, expected: str, error: DatasetError) -> Violation:
    return Violation(file, "", expected, first_line(error))


def _check_info(info: Mapping[str, Any]) -> Iterator[Violation]:
    wrong = check_form(InfoRecord, info, schema.INFO_FILE)
    yield from wrong
    for key, expected, found in wrong_shapes(info["features"]) if not wrong else ():
        yield Violation(schema.INFO_FILE, key, str(expected), str(found))


def _check_counts(dataset: LeRobotDataset) -> Iterator[Violation]:
    """Compare numbers of rows with ``info.json``; readers and later checks then expect those of the tables."""
    episodes = sorted((dataset.root / "meta/episodes").glob("*/*.parquet"))
    for key, paths in (("total_episodes", episodes), ("total_tasks", [dataset.root / schema.TASKS_FILE])):
        count = 0
        for path in paths:
            with open_table(path) as file:
                count += file.metadata.num_rows
        yield from _check_total(dataset, key, count, MAX_EPISODES)


def _check_total(dataset: LeRobotDataset, key: str, found: int, greatest: int) -> Iterator[Violation]:
    if dataset.info[key] != found:
        yield Violation(schema.INFO_FILE, key, str(found), str(dataset.info[key]))
        dataset.info[key] = min(found, greatest)


def _check_rows(dataset: LeRobotDataset) -> Iterator[Violation]:
    """Check the columns of ``meta/episodes``, on which the other checks rely."""
    numbers: list[int] = []
    for path, table in dataset.tables_of_episodes():
        name = str(path.relative_to(dataset.root))
        wrong = list(faults(table, episode_columns(table.column_names, dataset.info["features"])))
        yield from (Violation(name, key, expected, found) for key, expected, found in wrong)
        numbers += table.column("episode_index").to_pylist() if not wrong else []
    if len(set(numbers)) < len(numbers):
        yield Violation("meta/episodes", "episode_index", "each episode once", "some twice")


def _check_totals(dataset: LeRobotDataset) -> Iterator[Violation]:
    frames = sum(sum(table.column("length").to_pylist()) for _, table in dataset.tables_of_episodes())
    yield from _check_total(dataset, "total_frames", frames, MAX_FRAMES)
    if len(set(dataset.tasks)) != len(dataset.tasks):
        yield Violation(schema.TASKS_FILE, "", "each text once", "some twice")
    start = 0
    for index, row in enumerate(dataset.rows):
        end = start + row["length"]
        for key, value in (("episode_index", index), ("dataset_from_index", start), ("dataset_to_index", end)):
            if row[key] != value:
                yield Violation("meta/episodes", f"episode {index}, {key}", str(value), str(row[key]))
        start = end


def _check_data(
    dataset: LeRobotDataset, texts: Texts, on_episode: Callable[[int, int], None]
) -> tuple[list[Violation], Ranges]:
    """What is wrong with the frames, each file opened once, and the ranges of their numbers."""
    root, features = dataset.root, dataset.info["features"]
    wanted = sorted(key for key, feature in features.items() if feature["dtype"] != "video")
    by_file: dict[Path, list[dict[str, Any]]] = defaultdict(list)
    for row in dataset.rows:
        place = row["data/chunk_index"], row["data/file_index"]
        by_file[schema.data_file(root, schema.DATA_PATH, *place)].append(row)
    violations: list[Violation] = []
    ranges: Ranges = {}
    done = 0
    for path, inside in by_file.items():
        name, count = str(path.relative_to(root)), sum(row["length"] for row in inside)
        try:
            with open_table(path) as file:
                names, found = sorted(file.schema_arrow.names), file.metadata.num_rows
            if names != wanted:
                violations.append(Violation(name, "columns", ", ".join(wanted), ", ".join(names)))
            if found != count:
                violations.append(Violation(name, "rows", str(count), str(found)))
            if names != wanted or found != count:
                continue
            for row in inside:  # one at a time: memory does not grow with the file
                table = read_rows(path, row["episode_index"])
                wrong = list(faults(table, frame_columns(features)))
                if wrong:
                    violations += [Violation(name, key, expected, found) for key, expected, found in wrong]
                    break
                frames = _frames(table, name, row, features)
                violations += check_frames(frames, dataset.info, texts)
                ranges = _widened(ranges, frames, features)
                done += 1
                on_episode(done, len(dataset.rows))
        except DatasetError as error:
            violations.append(_violation(name, "a readable table", error))
    others = sorted(path for path in (root / "data").rglob("*") if path.is_file() and path not in by_file)
    extra = (Violation(str(path.relative_to(root)), "", "files of episodes only", "of none") for path in others)
    return [*violations, *extra], ranges


def _frames(table: pa.Table, name: str, row: Mapping[str, Any], features: Mapping[str, Any]) -> Frames:
    numeric = [key for key, feature in features.items() if feature["dtype"] not in ("video", "string", "image")]
    key = schema.SUBGOAL_TYPE.key
    types = table.column(key).to_pylist() if key in table.column_names else []
    return Frames(name, row, len(table), {key: numbers(table.column(key)) for key in numeric}, types)


def _widened(ranges: Ranges, frames: Frames, features: Mapping[str, Any]) -> Ranges:
    """Ranges with another episode's; what is no finite number does not count."""
    wide = dict(ranges)
    for key, values in frames.columns.items():
        if len(values) and not _fault(values, features[key]):
            low, high, count = ranges.get(key, (values[0], values[0], 0))
            wide[key] = np.minimum(low, values.min(axis=0)), np.maximum(high, values.max(axis=0)), count + len(values)
    return wide


def _fault(values: NDArray, feature: Mapping[str, Any]) -> tuple[str, str] | None:
    """What is expected of numbers, and found."""
    if values.shape[1] != int(np.prod(feature["shape"])):
        return f"{feature['shape']} numbers", str(values.shape[1])
    wrong = np.argwhere(~np.isfinite(values))
    return ("finite numbers", f"{values[wrong[0, 0]]} at frame {wrong[0, 0]}") if len(wrong) else None


def check_frames(frames: Frames, info: Mapping[str, Any], texts: Texts) -> Iterator[Violation]:
    """Check an episode's frames: what they count, when, of what; and that they agree with each other."""
    length, columns = frames.row["length"], frames.columns
    if frames.count != length or length == 0:
        yield frames.violation("", count_of(length, "frame") if length else "frames", frames.count or "none")
        return
    faults = [(key, fault) for key, found in columns.items() if (fault := _fault(found, info["features"][key]))]
    yield from (frames.violation(key, *fault) for key, fault in faults)
    steps = np.arange(length)
    start, index = frames.row["dataset_from_index"], frames.row["episode_index"]
    expected = {"frame_index": steps, "index": start + steps, "episode_index": np.full(length, index)}
    for key, values in expected.items():
        if not np.array_equal(columns[key][:, 0], values):
            yield frames.violation(key, f"{values[0]} to {values[-1]}", "others")
    late = np.abs(columns["timestamp"][:, 0] - steps / info["fps"])
    if not (late < TOLERANCE).all():
        step = int(late.argmax())
        found = f"{columns['timestamp'][step, 0]} s"
        yield frames.violation(f"timestamp {step}", f"{step / info['fps']} s", found)
    unknown = list(_check_texts(frames, texts))
    yield from unknown
    if not faults and not unknown:
        yield from _check_content(frames)


def _check_texts(frames: Frames, texts: Texts) -> Iterator[Violation]:
    for key, known in texts.items():
        used = set(frames.columns[key][:, 0].tolist()) if key in frames.columns else set()
        if not used <= set(range(len(known))):
            yield frames.violation(key, f"0 to {len(known) - 1}", sorted(used))
        elif key == "task_index" and {known[i] for i in used} != set(frames.row["tasks"]):
            expected = str([known[i] for i in used])
            yield replace(frames.violation("tasks", expected, frames.row["tasks"]), file="meta/episodes")


def _check_content(frames: Frames) -> Iterator[Violation]:
    """Check what frames of ours say as the arrays of a RoboCAS folder are, and that actions lead to the next state."""
    columns, key = frames.columns, schema.SUBGOAL_TYPE.key
    arrays: dict[str, NDArray] = {"step_goal_type": np.array([str(kind) for kind in frames.types], np.str_)}
    if {feature.key for feature in schema.FEATURES} <= set(columns):
        state, command, status = columns["observation.state"], columns["action"], columns["observation.gripper_open"]
        if not np.array_equal(command[:, 6], np.append(status[1:], status[-1:])):
            yield frames.violation("action", "the gripper's command of the next step", "another")
        if not np.array_equal(columns["action.joint"][:, :7], np.concatenate([state[1:, 7:14], state[-1:, 7:14]])):
            yield frames.violation("action.joint", "the next step's joints", "others")
        quaternions = np.linalg.norm([state[:, 3:7], columns["observation.arm_base"][:, 3:]], axis=-1)
        if quaternions.min() < 0.5:
            yield frames.violation("observation.state, observation.arm_base", "unit quaternions", "others")
            return
        turns = Rotation.from_euler("xyz", command[:, 3:6]).as_quat()
        instruction, types = next(iter(frames.row["tasks"]), ""), arrays["step_goal_type"].tolist()
        arrays = {**schema.robocas_arrays(dict(columns), instruction, [], types), "rel_orn": turns}
    for wrong in laws.violations_of(EpisodeArrays(Path(frames.file), arrays), (laws.check_units, *laws.CONTENT)):
        yield frames.violation(key if wrong.key == "step_goal_type" else wrong.key, wrong.expected, wrong.found)


def _check_statistics(dataset: LeRobotDataset, ranges: Ranges) -> Iterator[Violation]:
    """``stats.json`` has every feature, and the ranges that the data have."""
    stats = read_object(dataset.root, schema.STATS_FILE, absent="JSON")
    if stats.wrong:
        yield stats.wrong
        return
    for key, feature in dataset.info["features"].items():
        if feature["dtype"] == "string":
            continue
        found = stats.content.get(key, {})
        if not isinstance(found, dict):
            yield Violation(schema.STATS_FILE, key, "an object", type(found).__name__)
            continue
        missing = {"min", "max", "mean", "std", "count", *QUANTILES} - set(found)
        if missing:
            yield Violation(schema.STATS_FILE, key, ", ".join(sorted(missing)), "nothing")
            continue
        shape = (3, 1, 1) if feature["dtype"] == "video" else tuple(feature["shape"])
        wrong = [name for name, value in found.items() if name != "count" and shape_of(value) != shape]
        if wrong:
            shown = f"{shape_of(found[wrong[0]])}"
            yield Violation(schema.STATS_FILE, f"{key}, {wrong[0]}", f"shape {shape}", shown)
        elif outside := _outside(found):
            yield Violation(schema.STATS_FILE, f"{key}, {outside}", "between min and max", str(found[outside])[:80])
        elif key in ranges:
            low, high, count = ranges[key]
            same = np.allclose(found["min"], low, atol=1e-6) and np.allclose(found["max"], high, atol=1e-6)
            if not same or found["count"] != [count]:
                expected = f"min {low.tolist()}, max {high.tolist()}, count {count}"
                text = f"min {found['min']}, max {found['max']}, count {found['count']}"
                yield Violation(schema.STATS_FILE, key, expected, text)


def _outside(found: Mapping[str, Any]) -> str | None:
    """Return the first statistic of a feature that is outside of the range, or None."""
    low, high = (np.asarray(found[name], np.float64) for name in ("min", "max"))
    slack = 1e-3 * (1 + np.abs(low) + np.abs(high))  # of histograms and float32
    bounds = {name: (low - slack, high + slack) for name in ("mean", *QUANTILES)} | {"std": (0, high - low + slack)}
    return next(
        (k for k, (a, b) in bounds.items() if not ((a <= np.array(found[k])) & (np.array(found[k]) <= b)).all()), None
    )


def _check_checksums(root: Path) -> Iterator[Violation]:
    sums = read_object(root, schema.CHECKSUMS_FILE)
    if sums.wrong and (root / schema.CHECKSUMS_FILE).is_file():
        yield sums.wrong
    for name, expected in sums.content.items():
        if not isinstance(expected, str):
            yield Violation(schema.CHECKSUMS_FILE, name, "a SHA-256", type(expected).__name__)
        elif PurePosixPath(name).parts[:1] not in {(folder,) for folder in schema.CONTENT} or ".." in Path(name).parts:
            yield Violation(schema.CHECKSUMS_FILE, name, f"a file in {', '.join(schema.CONTENT)}", "another path")
        elif not (root / name).exists():
            yield Violation(name, "", "a file", "none")
        elif (found := _checksum(root / name)) != expected:
            yield Violation(name, "", f"the bytes that were written, SHA-256 {expected}", found)


def _checksum(path: Path) -> str:
    """Return the SHA-256 of a file, or why it cannot be read."""
    try:
        return schema.checksum(path)
    except (OSError, DocumentError) as error:
        return first_line(error)


def _check_conversion(dataset: LeRobotDataset) -> Iterator[Violation]:
    """Check how the dataset says it was made, where it does."""
    if not (dataset.root / schema.CONVERSION_FILE).exists():
        return
    made = read_object(dataset.root, schema.CONVERSION_FILE)
    wrong = [made.wrong] if made.wrong else check_form(ConversionRecord, made.content, schema.CONVERSION_FILE)
    yield from wrong
    sides = {key: made.content.get(key, []) for key in ("train_eps", "val_eps")} if not wrong else {}
    for key, unknown in unknown_numbers(sides, dataset.row_of).items():
        yield Violation(schema.CONVERSION_FILE, key, "numbers of episodes", str(unknown[:5]))


def _check_scenes(dataset: LeRobotDataset) -> Iterator[Violation]:
    """Check scenes and cameras of the episodes, where the dataset has them."""
    try:
        described = dataset.described
    except DatasetError as error:
        yield _violation(schema.SCENES_FILE, "a readable table", error)
        return
    if described and described.keys() != dataset.row_of.keys():
        found = sorted(described.keys() ^ dataset.row_of.keys())[:5]
        yield Violation(schema.SCENES_FILE, "episode_index", "the episodes of the dataset", f"{found} more or missing")
    for number in sorted(described.keys() & dataset.row_of.keys()):
        episode = dataset.episode(number)
        try:
            yield from check_values(episode.scene, f"{schema.SCENES_FILE}, episode {number}")
            for camera in dataset.cameras:
                episode.intrinsic(camera)
        except DatasetError as error:
            yield _violation(schema.SCENES_FILE, "scene and cameras", error)


def report_lerobot(root: Path, *, on_episode: Callable[[int, int], None] | None = None) -> Report:
    """`check_lerobot`, with how many episodes and steps were looked at."""
    looked = 0

    def count(done: int, total: int) -> None:
        nonlocal looked
        looked = done
        if on_episode:
            on_episode(done, total)

    violations = check_lerobot(root, on_episode=count)
    steps = read_object(root, schema.INFO_FILE).content.get("total_frames")
    return Report(looked, steps if isinstance(steps, int) else 0, violations)
