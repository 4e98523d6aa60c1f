"""Check the frames of a LeRobot dataset: lengths, indices, times, texts, and that features agree with each other."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.words import count_of
from robocas_ms3.datasets.checks import arrays as laws
from robocas_ms3.datasets.checks.violation import Violation
from robocas_ms3.datasets.lerobot import schema
from robocas_ms3.datasets.lerobot.arrays import robocas_arrays
from robocas_ms3.datasets.lerobot.check_language import check_language
from robocas_ms3.datasets.lerobot.check_videos import TOLERANCE
from robocas_ms3.datasets.lerobot.reader import LeRobotDataset
from robocas_ms3.datasets.lerobot.records import frame_columns
from robocas_ms3.datasets.lerobot.tables import faults, numbers, open_table, read_rows
from robocas_ms3.datasets.sources.tolerant import EpisodeArrays, first_line

Ranges = Mapping[str, tuple[NDArray, NDArray, int]]
"""Feature -> minimum and maximum of each of its numbers, and the number of frames."""
Texts = Mapping[str, list[str]]
"""Name of an index column, such as ``task_index`` -> the texts that it numbers."""


@dataclass(frozen=True)
class Frames:
    """The frames of an episode.

    Attributes:
        file: path of their table in the dataset.
        row: of the episode in ``meta/episodes``.
        count: number of frames.
        columns: numeric features (T, D).
        types: types of the sub-goals (T,); empty without that column.
    """

    file: str
    row: Mapping[str, Any]
    count: int
    columns: Mapping[str, NDArray]
    types: list[Any]

    def violation(self, key: str, expected: object, found: object) -> Violation:
        """Return a violation in this episode."""
        where = f"episode {self.row['episode_index']}"
        return Violation(self.file, f"{where}, {key}" if key else where, str(expected), str(found))


def check_data(
    dataset: LeRobotDataset, texts: Texts, on_episode: Callable[[int, int], None]
) -> tuple[list[Violation], Ranges]:
    """Return the violations in all frames, and the ranges of their numbers."""
    root, layout, features = dataset.root, dataset.layout, dataset.info["features"]
    wanted = sorted(key for key, feature in features.items() if feature["dtype"] != "video")
    by_file: dict[Path, list[dict[str, Any]]] = defaultdict(list)
    for row in dataset.rows:
        place = row["data/chunk_index"], row["data/file_index"]
        by_file[layout.path(root, layout.data, *place)].append(row)
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
                if dataset.has_language:
                    violations += check_language(table, name, row["episode_index"], dataset.info)
                ranges = _widened(ranges, frames, features)
                done += 1
                on_episode(done, len(dataset.rows))
        except DatasetError as error:
            violations.append(Violation(name, "", "a readable table", first_line(error)))
    others = sorted(path for path in (root / "data").rglob("*") if path.is_file() and path not in by_file)
    extra = (Violation(str(path.relative_to(root)), "", "files of episodes only", "of none") for path in others)
    return [*violations, *extra], ranges


def _frames(table: pa.Table, name: str, row: Mapping[str, Any], features: Mapping[str, Any]) -> Frames:
    numeric = [key for key, feature in features.items() if feature["dtype"] not in schema.NOT_NUMERIC]
    key = schema.SUBGOAL_TYPE.key
    types = table.column(key).to_pylist() if key in table.column_names else []
    return Frames(name, row, len(table), {key: numbers(table.column(key)) for key in numeric}, types)


def _widened(ranges: Ranges, frames: Frames, features: Mapping[str, Any]) -> Ranges:
    """Return the ranges extended by an episode; features with NaN or infinite values are ignored."""
    wide = dict(ranges)
    for key, values in frames.columns.items():
        if len(values) and not _fault(values, features[key]):
            low, high, count = ranges.get(key, (values[0], values[0], 0))
            wide[key] = np.minimum(low, values.min(axis=0)), np.maximum(high, values.max(axis=0)), count + len(values)
    return wide


def _fault(values: NDArray, feature: Mapping[str, Any]) -> tuple[str, str] | None:
    """Return expected and found, if the width is wrong or a number is NaN or infinite."""
    if values.shape[1] != int(np.prod(feature["shape"])):
        return f"{feature['shape']} numbers", str(values.shape[1])
    wrong = np.argwhere(~np.isfinite(values))
    return ("finite numbers", f"{values[wrong[0, 0]]} at frame {wrong[0, 0]}") if len(wrong) else None


def check_frames(frames: Frames, info: Mapping[str, Any], texts: Texts) -> Iterator[Violation]:
    """Check the indices, timestamps, texts and outcome of an episode's frames, and that features are consistent."""
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
    yield from _check_outcome(frames)
    if not faults and not unknown:
        yield from _check_content(frames)


def _check_outcome(frames: Frames) -> Iterator[Violation]:
    """Check that an episode ends in its last frame, and succeeds there or nowhere."""
    columns, last = frames.columns, np.arange(frames.count) == frames.count - 1
    if any(feature.key not in columns for feature in schema.OUTCOME):
        return
    reward, success, done = (columns[feature.key][:, 0] for feature in schema.OUTCOME)
    if not np.array_equal(done != 0, last):
        yield frames.violation(schema.DONE.key, "true in the last frame only", "another")
    if (success[~last] != 0).any():
        yield frames.violation(schema.SUCCESS.key, "true in the last frame only", "true before")
    if not np.array_equal(reward, success.astype(np.float64)):
        yield frames.violation(schema.REWARD.key, "1 where next.success, else 0", "another")


def _check_texts(frames: Frames, texts: Texts) -> Iterator[Violation]:
    for key, known in texts.items():
        used = set(frames.columns[key][:, 0].tolist()) if key in frames.columns else set()
        if not used <= set(range(len(known))):
            yield frames.violation(key, f"0 to {len(known) - 1}", sorted(used))
        elif key == "task_index" and {known[i] for i in used} != set(frames.row["tasks"]):
            expected = str([known[i] for i in used])
            yield replace(frames.violation("tasks", expected, frames.row["tasks"]), file="meta/episodes")


def _check_content(frames: Frames) -> Iterator[Violation]:
    """Check the values by the rules for RoboCAS folders, and that each action leads to the next state."""
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
        arrays = {**robocas_arrays(dict(columns), instruction, [], types), "rel_orn": turns}
    for wrong in laws.violations_of(EpisodeArrays(Path(frames.file), arrays), (laws.check_units, *laws.CONTENT)):
        yield frames.violation(key if wrong.key == "step_goal_type" else wrong.key, wrong.expected, wrong.found)
