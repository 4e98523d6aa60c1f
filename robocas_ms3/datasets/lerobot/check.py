"""Checks a LeRobot dataset against its own declarations: lengths, numbers, times, videos, texts, statistics."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from robocas_ms3.datasets.checks.dataset import Report
from robocas_ms3.datasets.checks.violation import Violation
from robocas_ms3.datasets.lerobot import schema
from robocas_ms3.datasets.lerobot.check_videos import TOLERANCE, check_videos
from robocas_ms3.datasets.lerobot.stats import QUANTILES
from robocas_ms3.datasets.lerobot.tables import numbers, read_texts
from robocas_ms3.datasets.schema import GOAL_TYPES

_KEYS = ("codebase_version", "total_episodes", "total_frames", "total_tasks", "fps", "splits", "features", "data_path")


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
        What is wrong, in the order of discovery; empty for a valid dataset.

    Raises:
        MissingExtraError: the ``lerobot`` extra is not installed.
    """
    schema.require_extra()
    return list(_Check(Path(root), decode, on_episode or (lambda *_: None)).run())


class _Check:
    def __init__(self, root: Path, decode: bool, on_episode: Callable[[int, int], None]) -> None:
        self.root, self.decode, self.on_episode = root, decode, on_episode
        self.info: dict[str, Any] = {}
        self.ranges: dict[str, tuple[np.ndarray, np.ndarray, int]] = {}

    def run(self) -> Iterator[Violation]:
        """Everything; what can't be read ends it."""
        try:
            self.info = json.loads((self.root / schema.INFO_FILE).read_text(encoding="utf-8"))
            missing = [key for key in _KEYS if key not in self.info]
        except (OSError, ValueError) as error:
            yield Violation(schema.INFO_FILE, "", "JSON", _say(error))
            return
        if missing:
            yield Violation(schema.INFO_FILE, ", ".join(missing), "a value", "nothing")
            return
        if self.info["codebase_version"] != schema.CODEBASE_VERSION:
            found = str(self.info["codebase_version"])
            yield Violation(schema.INFO_FILE, "codebase_version", schema.CODEBASE_VERSION, found)
            return
        if not isinstance(self.info["fps"], int):
            yield Violation(schema.INFO_FILE, "fps", "a whole number", str(self.info["fps"]))
            return
        try:
            self.tasks = read_texts(self.root / schema.TASKS_FILE)
            subtasks = schema.SUBTASK_INDEX.key in self.info["features"]
            self.subtasks = read_texts(self.root / schema.SUBTASKS_FILE) if subtasks else []
            rows = self._episodes()
        except (OSError, pa.ArrowException, KeyError) as error:
            yield Violation("meta", "", "readable tables", _say(error))
            return
        yield from self._totals(rows)
        yield from self._each(rows)
        yield from self._statistics()
        yield from self._checksums()

    def _episodes(self) -> list[dict[str, Any]]:
        found: list[dict[str, Any]] = []
        for path in sorted((self.root / "meta/episodes").glob("*/*.parquet")):
            with pq.ParquetFile(path) as file:
                names = [n for n in file.schema_arrow.names if not n.startswith("stats/") or n.endswith("/count")]
                found += file.read(columns=names).to_pylist()
        return found

    def _totals(self, rows: list[dict[str, Any]]) -> Iterator[Violation]:
        found = {"total_episodes": len(rows), "total_frames": sum(row["length"] for row in rows)}
        found["total_tasks"] = len(self.tasks)
        for key, value in found.items():
            if self.info[key] != value:
                yield Violation(schema.INFO_FILE, key, str(value), str(self.info[key]))
        if len(set(self.tasks)) != len(self.tasks):
            yield Violation(schema.TASKS_FILE, "", "each text once", "some twice")
        start = 0
        for index, row in enumerate(rows):
            expected = {
                "episode_index": index,
                "dataset_from_index": start,
                "dataset_to_index": start + row["length"],
            }
            for key, value in expected.items():
                if row[key] != value:
                    yield Violation("meta/episodes", f"episode {index}, {key}", str(value), str(row[key]))
            start += row["length"]

    def _each(self, rows: list[dict[str, Any]]) -> Iterator[Violation]:
        """Data files and videos, each opened once."""
        features = self.info["features"]
        by_file: dict[tuple[int, int], list[dict[str, Any]]] = defaultdict(list)
        for row in rows:
            by_file[row["data/chunk_index"], row["data/file_index"]].append(row)
        done = 0
        for place, inside in by_file.items():
            path = schema.data_file(self.root, self.info["data_path"], *place)
            name = str(path.relative_to(self.root))
            try:
                with pq.ParquetFile(path) as file:
                    yield from self._columns(name, file.schema_arrow.names)
                    if file.metadata.num_rows != sum(row["length"] for row in inside):
                        expected = str(sum(row["length"] for row in inside))
                        yield Violation(name, "rows", expected, str(file.metadata.num_rows))
                        continue
                for row in inside:  # one at a time: memory does not grow with the file
                    yield from self._episode(name, row, _rows_of(path, row["episode_index"]))
                    done += 1
                    self.on_episode(done, len(rows))
            except (OSError, pa.ArrowException, KeyError) as error:
                yield Violation(name, "", "a readable table", _say(error))
        files = {str(p.relative_to(self.root)) for p in (self.root / "data").rglob("*") if p.is_file()}
        files -= {
            str(schema.data_file(self.root, self.info["data_path"], *place).relative_to(self.root)) for place in by_file
        }
        yield from (Violation(name, "", "files of episodes only", "of none") for name in sorted(files))
        for key, feature in features.items():
            if feature["dtype"] == "video":
                yield from check_videos(self.root, self.info, rows, key, self.decode)

    def _columns(self, name: str, found: list[str]) -> Iterator[Violation]:
        expected = {key for key, feature in self.info["features"].items() if feature["dtype"] != "video"}
        if set(found) != expected:
            yield Violation(name, "columns", ", ".join(sorted(expected)), ", ".join(sorted(found)))

    def _episode(self, name: str, row: dict[str, Any], table: pa.Table) -> Iterator[Violation]:
        index, length, start = row["episode_index"], row["length"], row["dataset_from_index"]
        where = f"episode {index}"
        if len(table) != length:
            yield Violation(name, where, f"{length} frames", str(len(table)))
            return
        if length == 0:
            yield Violation(name, where, "frames", "none")
            return
        columns = {}
        for key, feature in self.info["features"].items():
            if feature["dtype"] in ("video", "string", "image"):
                continue
            values = columns[key] = numbers(table.column(key))
            if values.shape[1] != int(np.prod(feature["shape"])):
                yield Violation(name, f"{where}, {key}", f"{feature['shape']} numbers", str(values.shape[1]))
            elif not np.isfinite(values).all():
                step = int(np.argwhere(~np.isfinite(values))[0, 0])
                yield Violation(name, f"{where}, {key}", "finite numbers", f"{values[step]} at frame {step}")
            else:
                self._widen(key, values)
        steps = np.arange(length)
        expected = {"frame_index": steps, "index": start + steps, "episode_index": np.full(length, index)}
        for key, values in expected.items():
            if not np.array_equal(columns[key][:, 0], values):
                yield Violation(name, f"{where}, {key}", f"{values[0]} to {values[-1]}", "others")
        late = np.abs(columns["timestamp"][:, 0] - steps / self.info["fps"])
        if not (late < TOLERANCE).all():
            step = int(late.argmax())
            found = f"{columns['timestamp'][step, 0]} s"
            yield Violation(name, f"{where}, timestamp {step}", f"{step / self.info['fps']} s", found)
        yield from self._texts(name, where, row, table, columns)
        yield from self._actions(name, where, columns)

    def _widen(self, key: str, values: np.ndarray) -> None:
        low, high, count = values.min(axis=0), values.max(axis=0), len(values)
        if key in self.ranges:
            before = self.ranges[key]
            low, high, count = np.minimum(low, before[0]), np.maximum(high, before[1]), count + before[2]
        self.ranges[key] = low, high, count

    def _texts(
        self, name: str, where: str, row: dict[str, Any], table: pa.Table, columns: dict[str, np.ndarray]
    ) -> Iterator[Violation]:
        numbered = {"task_index": self.tasks, schema.SUBTASK_INDEX.key: self.subtasks}
        for key, texts in numbered.items():
            if key in columns:
                used = set(columns[key][:, 0].tolist())
                if not used <= set(range(len(texts))):
                    yield Violation(name, f"{where}, {key}", f"0 to {len(texts) - 1}", str(sorted(used)))
                elif key == "task_index" and {texts[i] for i in used} != set(row["tasks"]):
                    yield Violation(
                        "meta/episodes", f"{where}, tasks", str([texts[i] for i in used]), str(row["tasks"])
                    )
        if schema.SUBGOAL_TYPE.key in table.column_names:
            unknown = set(table.column(schema.SUBGOAL_TYPE.key).to_pylist()) - set(GOAL_TYPES)
            if unknown:
                expected = "one of " + ", ".join(GOAL_TYPES)
                yield Violation(name, f"{where}, {schema.SUBGOAL_TYPE.key}", expected, str(sorted(map(str, unknown))))

    def _actions(self, name: str, where: str, columns: dict[str, np.ndarray]) -> Iterator[Violation]:
        """What `action` says must be what the next state shows; only datasets of ours have these columns."""
        if not {feature.key for feature in schema.FEATURES} <= set(columns):
            return
        state, command = columns["observation.state"], columns["action"][:, 6]
        status = columns["observation.gripper_open"][:, 0]
        if not np.array_equal(command, np.append(status[1:], status[-1:])):
            yield Violation(name, f"{where}, action", "the gripper's command of the next step", "another")
        joints = columns["action.joint"][:, :7]
        if not np.array_equal(joints, np.concatenate([state[1:, 7:14], state[-1:, 7:14]])):
            yield Violation(name, f"{where}, action.joint", "the next step's joints", "others")

    def _statistics(self) -> Iterator[Violation]:
        """``stats.json`` has every feature, and the ranges that the data have."""
        try:
            stats = json.loads((self.root / schema.STATS_FILE).read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            yield Violation(schema.STATS_FILE, "", "JSON", _say(error))
            return
        for key, feature in self.info["features"].items():
            if feature["dtype"] == "string":
                continue
            found = stats.get(key, {})
            missing = {"min", "max", "mean", "std", "count", *QUANTILES} - set(found)
            if missing:
                yield Violation(schema.STATS_FILE, key, ", ".join(sorted(missing)), "nothing")
                continue
            shape = (3, 1, 1) if feature["dtype"] == "video" else tuple(feature["shape"])
            wrong = [name for name, value in found.items() if name != "count" and np.shape(value) != shape]
            if wrong:
                yield Violation(
                    schema.STATS_FILE, f"{key}, {wrong[0]}", f"shape {shape}", f"{np.shape(found[wrong[0]])}"
                )
            elif key in self.ranges:
                low, high, count = self.ranges[key]
                same = np.allclose(found["min"], low, atol=1e-6) and np.allclose(found["max"], high, atol=1e-6)
                if not same or found["count"] != [count]:
                    expected = f"min {low.tolist()}, max {high.tolist()}, count {count}"
                    text = f"min {found['min']}, max {found['max']}, count {found['count'][0]}"
                    yield Violation(schema.STATS_FILE, key, expected, text)

    def _checksums(self) -> Iterator[Violation]:
        path = self.root / schema.CHECKSUMS_FILE
        if not path.is_file():
            return
        try:
            sums = json.loads(path.read_text(encoding="utf-8"))
        except ValueError as error:
            yield Violation(schema.CHECKSUMS_FILE, "", "JSON", _say(error))
            return
        for name, expected in sums.items():
            if not (self.root / name).is_file():
                yield Violation(name, "", "a file", "none")
            elif (found := schema.checksum(self.root / name)) != expected:
                yield Violation(name, "", f"the bytes that were written, SHA-256 {expected[:12]}", found[:12])


def _rows_of(path: Path, episode: int) -> pa.Table:
    return pq.read_table(path, filters=[("episode_index", "=", episode)])


def _say(error: Exception) -> str:
    text = str(error).strip() or type(error).__name__
    return text.splitlines()[0]


def report_lerobot(root: Path, *, on_episode: Callable[[int, int], None] | None = None) -> Report:
    """`check_lerobot`, with how many episodes and steps were looked at."""
    looked = 0

    def count(done: int, total: int) -> None:
        nonlocal looked
        looked = done
        if on_episode:
            on_episode(done, total)

    violations, steps = check_lerobot(root, on_episode=count), 0
    with suppress(OSError, ValueError, KeyError, TypeError):  # told among the violations
        steps = int(json.loads((root / schema.INFO_FILE).read_text(encoding="utf-8"))["total_frames"])
    return Report(looked, steps, violations)
