"""Checks a LeRobot dataset against its own declarations: lengths, numbers, times, videos, texts, statistics."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path, PurePosixPath

from robocas_ms3.core.documents import DocumentError
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.words import one_line
from robocas_ms3.datasets.checks.dataset import Report
from robocas_ms3.datasets.checks.scene import check_values
from robocas_ms3.datasets.checks.violation import Violation, read_object
from robocas_ms3.datasets.lerobot import schema
from robocas_ms3.datasets.lerobot.check_content import check_statistics, check_videos
from robocas_ms3.datasets.lerobot.check_frames import check_data
from robocas_ms3.datasets.lerobot.reader import LeRobotDataset
from robocas_ms3.datasets.lerobot.records import (
    MAX_EPISODES,
    MAX_FRAMES,
    ConversionRecord,
    EpisodeLine,
    InfoRecord,
    TaskLine,
    episode_columns,
    read_lines,
    unknown_numbers,
)
from robocas_ms3.datasets.lerobot.tables import faults, open_table


def check_lerobot(
    root: str | Path, *, decode: bool = False, on_episode: Callable[[int, int], None] | None = None
) -> list[Violation]:
    """Check a dataset; datasets made elsewhere are checked as far as they have what ours have.

    Args:
        root: folder of the dataset.
        decode: decode every frame; otherwise frames are counted. FFmpeg's decoders conceal damage inside a video, which
            shows by the checksums that datasets made here have.
        on_episode: called with the number of episodes done and of all.

    Returns:
        Violations; empty for a valid dataset.

    Raises:
        MissingExtraError: the ``lerobot`` extra is not installed.
    """
    schema.require_extra()
    root = Path(root)
    info, wrong = read_object(root, schema.INFO_FILE, InfoRecord, absent="JSON")
    features = {} if wrong else info["features"]
    if set(schema.OUR_KEYS) <= set(features):
        for own in schema.FEATURES:
            if (shape := features[own.key]["shape"]) != [own.width]:
                wrong.append(Violation(schema.INFO_FILE, f"features.{own.key}.shape", str([own.width]), str(shape)))
    if wrong:
        return wrong
    try:
        dataset = LeRobotDataset(root)
        totals = list(_check_counts(dataset))
        wrong = list(_check_rows(dataset))
        if wrong:
            return [*totals, *wrong]
        totals += _check_totals(dataset)
        texts = {"task_index": dataset.tasks}
        if schema.SUBTASK_INDEX.key in features:
            texts[schema.SUBTASK_INDEX.key] = dataset.subtasks
    except DatasetError as error:
        return [Violation("meta", "", "readable tables", one_line(error))]
    data, ranges = check_data(dataset, texts, on_episode or (lambda *_: None))
    videos = [key for key, feature in features.items() if feature["dtype"] == "video"]
    return [
        *totals,
        *data,
        *(wrong for key in videos for wrong in check_videos(dataset, key, decode)),
        *check_statistics(dataset, ranges),
        *_check_conversion(dataset),
        *_check_scenes(dataset),
        *_check_checksums(root),
    ]


def _check_counts(dataset: LeRobotDataset) -> Iterator[Violation]:
    """Compare numbers of rows with ``info.json``; readers and later checks then expect those of the tables."""
    root = dataset.root
    if dataset.layout.one_file_per_episode:
        counts = {
            "total_episodes": len(read_lines(root / schema.EPISODES_LINES, EpisodeLine, MAX_EPISODES)),
            "total_tasks": len(read_lines(root / schema.TASKS_LINES, TaskLine, MAX_EPISODES)),
        }
    else:
        episodes = sorted((root / "meta/episodes").glob("*/*.parquet"))
        counts = {"total_episodes": sum(map(_rows, episodes)), "total_tasks": _rows(root / schema.TASKS_FILE)}
    for key, count in counts.items():
        yield from _check_total(dataset, key, count, MAX_EPISODES)


def _rows(path: Path) -> int:
    with open_table(path) as file:
        return file.metadata.num_rows


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
        yield from (Violation(name, *fault) for fault in wrong)
        numbers += table.column("episode_index").to_pylist() if not wrong else []
    if len(set(numbers)) < len(numbers):
        yield Violation("meta/episodes", "episode_index", "each episode once", "some twice")


def _check_totals(dataset: LeRobotDataset) -> Iterator[Violation]:
    frames = sum(sum(table.column("length").to_pylist()) for _, table in dataset.tables_of_episodes())
    yield from _check_total(dataset, "total_frames", frames, MAX_FRAMES)
    if len(set(dataset.tasks)) != len(dataset.tasks):
        tasks = schema.TASKS_LINES if dataset.layout.one_file_per_episode else schema.TASKS_FILE
        yield Violation(tasks, "", "each text once", "some twice")
    start = 0
    for index, row in enumerate(dataset.rows):
        end = start + row["length"]
        for key, value in (("episode_index", index), ("dataset_from_index", start), ("dataset_to_index", end)):
            if row[key] != value:
                yield Violation("meta/episodes", f"episode {index}, {key}", str(value), str(row[key]))
        start = end


def _check_checksums(root: Path) -> Iterator[Violation]:
    sums, wrong = read_object(root, schema.CHECKSUMS_FILE)
    if (root / schema.CHECKSUMS_FILE).is_file():
        yield from wrong
    for name, expected in sums.items():
        inside = PurePosixPath(name).parts[0] in schema.CONTENT and ".." not in Path(name).parts
        if not isinstance(expected, str):
            yield Violation(schema.CHECKSUMS_FILE, name, "a SHA-256", type(expected).__name__)
        elif not inside:
            yield Violation(schema.CHECKSUMS_FILE, name, f"a file in {', '.join(schema.CONTENT)}", "another path")
        elif not (root / name).exists():
            yield Violation(name, "", "a file", "none")
        else:
            try:
                found = schema.checksum(root / name)
            except (OSError, DocumentError) as error:
                found = one_line(error)
            if found != expected:
                yield Violation(name, "", f"the bytes that were written, SHA-256 {expected}", found)


def _check_conversion(dataset: LeRobotDataset) -> Iterator[Violation]:
    """Check how the dataset says it was made, if it does."""
    if not (dataset.root / schema.CONVERSION_FILE).exists():
        return
    made, wrong = read_object(dataset.root, schema.CONVERSION_FILE, ConversionRecord)
    yield from wrong
    sides = {key: made.get(key, []) for key in ("train_eps", "val_eps")} if not wrong else {}
    for key, unknown in unknown_numbers(sides, dataset.row_of).items():
        yield Violation(schema.CONVERSION_FILE, key, "numbers of episodes", str(unknown[:5]))


def _check_scenes(dataset: LeRobotDataset) -> Iterator[Violation]:
    """Check scenes and cameras of the episodes, if the dataset has them."""
    try:
        described = dataset.described
    except DatasetError as error:
        yield Violation(schema.SCENES_FILE, "", "a readable table", one_line(error))
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
            yield Violation(schema.SCENES_FILE, "", "scene and cameras", one_line(error))


def report_lerobot(root: Path, *, on_episode: Callable[[int, int], None] | None = None) -> Report:
    """Check a dataset; return the violations and the numbers of episodes and steps."""
    checked = 0

    def count(done: int, total: int) -> None:
        nonlocal checked
        checked = done
        if on_episode:
            on_episode(done, total)

    violations = check_lerobot(root, on_episode=count)
    steps = read_object(root, schema.INFO_FILE)[0].get("total_frames")
    return Report(checked, steps if isinstance(steps, int) else 0, violations)
