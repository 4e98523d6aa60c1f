"""Check the frames of a LeRobot dataset: lengths, indices, times, texts, and consistency of features."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Container, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.text import format_count, one_line
from robocas_ms3.datasets.checks import arrays as array_checks
from robocas_ms3.datasets.checks.violation import Violation
from robocas_ms3.datasets.lerobot import schema
from robocas_ms3.datasets.lerobot.arrays import to_frame_columns, to_robocas_arrays
from robocas_ms3.datasets.lerobot.file_models import declare_frame_columns
from robocas_ms3.datasets.lerobot.language import EVENTS, PERSISTENT, Row, parse_box, read_language_rows
from robocas_ms3.datasets.lerobot.reader import LeRobotDataset
from robocas_ms3.datasets.lerobot.tables import find_column_violations, open_table, read_episode_rows, to_array
from robocas_ms3.datasets.sources.arrays import EpisodeArrays
from robocas_ms3.datasets.sources.file_models import has_action_noise

TOLERANCE = 1e-4
"""Tolerance of timestamps in s, as in LeRobot."""
Ranges = dict[str, tuple[NDArray, NDArray, int]]
"""Minimum, maximum and number of frames, by feature."""
Texts = Mapping[str, list[str]]
"""Texts by the name of their index column, such as ``task_index``."""
Columns = Mapping[str, NDArray]
KeyViolation = tuple[str, str, str]
"""Violation of one file: key, expected and found."""
_PERSISTENT_STYLES = {"subtask", "plan", "memory", "motion", "task_aug"}
_EVENT_STYLES = {"interjection", "vqa", "trace", None}
_CAMERA_STYLES = {"vqa", "trace"}


def check_data(
    dataset: LeRobotDataset, texts: Texts, on_episode: Callable[[int, int], None]
) -> tuple[list[Violation], Ranges]:
    """Check all frames; return the violations, and the range of each numeric feature in the data.

    ``on_episode`` is called with (done, total) after each episode.
    """
    root, features, by_file = dataset.root, dataset.info["features"], dataset.rows_by_file("data")
    violations: list[Violation] = []
    ranges: Ranges = {}
    done = 0
    for path, rows in by_file.items():
        name = str(path.relative_to(root))
        try:
            wrong = list(_check_table_file(path, rows, features))
            violations += [Violation(name, *violation) for violation in wrong]
            for row in [] if wrong else rows:  # one at a time, to bound memory
                table, where = read_episode_rows(path, row["episode_index"]), f"episode {row['episode_index']}"
                if wrong := list(find_column_violations(table, declare_frame_columns(features))):
                    violations += [Violation(name, *violation) for violation in wrong]
                    break
                numeric = [key for key, feature in features.items() if feature["dtype"] not in schema.NOT_NUMERIC]
                columns = {key: to_array(table.column(key)) for key in numeric}
                has_noise = _has_action_noise(dataset, row["episode_index"])
                wrong = list(_check_episode(table, columns, row, dataset.info, texts, has_noise))
                if dataset.has_language:
                    wrong += check_language(table, name, dataset.info)
                violations += [
                    Violation(name, f"{where}, {key}" if key else where, expected, found)
                    for key, expected, found in wrong
                ]
                _extend_ranges(ranges, columns, features)
                done += 1
                on_episode(done, len(dataset.rows))
        except DatasetError as error:
            violations.append(Violation(name, "", "a readable table", one_line(error)))
    return [*violations, *find_unexpected_files(root, [root / "data"], by_file)], ranges


def find_unexpected_files(root: Path, folders: Iterable[Path], known: Container[Path]) -> Iterator[Violation]:
    """Yield a violation for each file in ``folders`` that is not in ``known``."""
    for path in sorted(path for folder in folders for path in folder.rglob("*") if path.is_file()):
        if path not in known:
            yield Violation(str(path.relative_to(root)), "", "files of episodes only", "a file of no episode")


def _check_table_file(path: Path, rows: list[dict[str, Any]], features: Mapping[str, Any]) -> Iterator[KeyViolation]:
    wanted = sorted(key for key, feature in features.items() if feature["dtype"] != "video")
    count = sum(row["length"] for row in rows)
    with open_table(path) as file:
        names, found = sorted(file.schema_arrow.names), file.metadata.num_rows
    if names != wanted:
        yield "columns", ", ".join(wanted), ", ".join(names)
    if found != count:
        yield "rows", str(count), str(found)


def _extend_ranges(ranges: Ranges, columns: Columns, features: Mapping[str, Any]) -> None:
    """Extend ``ranges`` by the values of an episode; features with NaN or infinite values are ignored."""
    for key, values in columns.items():
        if len(values) and not _find_number_violation(values, features[key]):
            low, high, count = ranges.get(key, (values[0], values[0], 0))
            ranges[key] = np.minimum(low, values.min(axis=0)), np.maximum(high, values.max(axis=0)), count + len(values)


def _find_number_violation(values: NDArray, feature: Mapping[str, Any]) -> tuple[str, str] | None:
    """Return (expected, found) if the width is wrong or a number is NaN or infinite, None otherwise."""
    if values.shape[1] != int(np.prod(feature["shape"])):
        return f"{feature['shape']} numbers", str(values.shape[1])
    wrong = np.argwhere(~np.isfinite(values))
    return ("finite numbers", f"{values[wrong[0, 0]]} at frame {wrong[0, 0]}") if len(wrong) else None


def _check_episode(
    table: pa.Table, columns: Columns, row: Mapping[str, Any], info: Mapping[str, Any], texts: Texts, has_noise: bool
) -> Iterator[KeyViolation]:
    """Check indices, timestamps, texts, outcome and values of an episode, with or without action noise."""
    length = row["length"]
    if len(table) != length:
        yield "", format_count(length, "frame"), str(len(table))
        return
    wrong = [
        (key, *fault)
        for key, found in columns.items()
        if (fault := _find_number_violation(found, info["features"][key]))
    ]
    yield from wrong
    steps = np.arange(length)
    expected = {
        "frame_index": steps,
        "index": row["dataset_from_index"] + steps,
        "episode_index": np.full(length, row["episode_index"]),
    }
    for key, values in expected.items():
        if not np.array_equal(columns[key][:, 0], values):
            yield key, f"{values[0]} to {values[-1]}", "other values"
    late = np.abs(columns["timestamp"][:, 0] - steps / info["fps"])
    if not (late < TOLERANCE).all():
        step = int(late.argmax())
        yield f"timestamp {step}", f"{step / info['fps']} s", f"{columns['timestamp'][step, 0]} s"
    unknown = list(_check_texts(columns, row["tasks"], texts))
    yield from unknown
    yield from _check_outcome(columns)
    if not wrong and not unknown:
        key = schema.SUBGOAL_TYPE.key
        types = table.column(key).to_pylist() if key in table.column_names else []
        yield from _check_content(columns, types, next(iter(row["tasks"]), ""), has_noise)


def _has_action_noise(dataset: LeRobotDataset, number: int) -> bool:
    try:
        return has_action_noise(dataset.episode(number).scene)
    except DatasetError:  # reported by the check of the scenes
        return False


def _check_outcome(columns: Columns) -> Iterator[KeyViolation]:
    if any(feature.key not in columns for feature in schema.OUTCOME):
        return
    reward, success, done = (columns[feature.key][:, 0] for feature in schema.OUTCOME)
    last = np.arange(len(done)) == len(done) - 1
    if not np.array_equal(done != 0, last):
        yield schema.DONE.key, "true in the last frame only", "other values"
    if (success[~last] != 0).any():
        yield schema.SUCCESS.key, "true in the last frame only", "true in an earlier frame"
    if not np.array_equal(reward, success.astype(np.float64)):
        yield schema.REWARD.key, "1 where next.success, else 0", "other values"


def _check_texts(columns: Columns, tasks: list[str], texts: Texts) -> Iterator[KeyViolation]:
    for key, known in texts.items():
        used = set(columns[key][:, 0].tolist()) if key in columns else set()
        if not used <= set(range(len(known))):
            yield key, f"0 to {len(known) - 1}", str(sorted(used))
        elif key == "task_index" and {known[i] for i in used} != set(tasks):
            yield key, f"the tasks of meta/episodes, {tasks}", str([known[i] for i in used])


def _check_content(columns: Columns, types: list[Any], instruction: str, has_noise: bool) -> Iterator[KeyViolation]:
    """Check the values with the rules of RoboCAS folders, and that each action leads to the next state.

    In episodes with action noise, actions do not lead to the next state.
    """
    arrays: dict[str, NDArray] = {"step_goal_type": np.array([str(kind) for kind in types], np.str_)}
    if set(schema.ROBOCAS_KEYS) <= set(columns):
        try:
            types = arrays["step_goal_type"].tolist()
            arrays = to_robocas_arrays(dict(columns), instruction, [], types, has_action_noise=has_noise)
        except ValueError as error:  # a quaternion of length 0
            yield "observation.state, observation.arm_base", "unit quaternions", one_line(error)
            return
        again, command = to_frame_columns(arrays), columns["action"]
        gripper = schema.ACTION_COLUMNS["gripper_open"]
        if not np.array_equal(command[:, gripper], again["action"][:, gripper]):
            yield "action", "the gripper command of the next step", "other values"
        if not np.array_equal(columns["action.joint"], again["action.joint"]):
            yield "action.joint", "joints and gripper of the next step", "other values"
        arrays["rel_orn"] = Rotation.from_euler("xyz", command[:, schema.ACTION_COLUMNS["rel_orn"]]).as_quat()
    for wrong in array_checks.run_checks(
        EpisodeArrays(Path(), arrays), (array_checks.check_unit_length, *array_checks.CONTENT_CHECKS)
    ):
        key = schema.SUBGOAL_TYPE.key if wrong.key == "step_goal_type" else wrong.key
        yield key, wrong.expected, wrong.found


def check_language(table: pa.Table, file: str, info: Mapping[str, Any]) -> Iterator[KeyViolation]:
    """Check the language rows of an episode from ``robocas convert`` or ``lerobot-annotate``."""
    persistent, events = (read_language_rows(table, key, file) for key in (PERSISTENT, EVENTS))
    if any(rows != persistent[0] for rows in persistent[1:]):
        yield PERSISTENT, "the same rows in each frame", "different rows"
        return
    for key, expected, found in _check_persistent(persistent[0] if persistent else [], len(table), info["fps"]):
        yield f"{PERSISTENT}, {key}", expected, found
    for step, rows in enumerate(events):
        for expected, found in _check_events(rows, info["features"]):
            yield f"{EVENTS}, frame {step}", expected, found


def _check_persistent(rows: list[Row], count: int, fps: int) -> Iterator[KeyViolation]:
    for row in rows:
        if row["style"] not in _PERSISTENT_STYLES:
            yield "style", ", ".join(sorted(_PERSISTENT_STYLES)), str(row["style"])
        step = row["timestamp"] * fps
        if abs(step - round(step)) > TOLERANCE * fps or not 0 <= round(step) < count:
            yield "timestamp", f"the time of a frame, 0 to {(count - 1) / fps:g} s", f"{row['timestamp']:g} s"
    starts = [row["timestamp"] for row in rows if row["style"] == "subtask"]
    if starts and min(starts) > TOLERANCE:
        yield "subtask", "a subtask at the first frame", f"the first at {min(starts):g} s"
    if len(set(starts)) < len(starts):
        yield "subtask", "one subtask at a time", "several at one time"


def _check_events(rows: list[Row], features: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    for row in rows:
        style, camera = row["style"], row["camera"]
        if style not in _EVENT_STYLES:
            yield "style interjection, vqa, trace or none", str(style)
        elif style not in _CAMERA_STYLES:
            continue
        elif camera not in features or features[camera]["dtype"] not in ("video", "image"):
            yield "a camera of the dataset", str(camera)
        elif row["role"] == "assistant" and (box := parse_box(row["content"])):
            height, width = features[camera]["shape"][:2]
            left, top, right, bottom = box
            if not (0 <= left <= right < width and 0 <= top <= bottom < height):
                yield f"a box in {width} x {height} pixels", str(list(box))
    pairs = Counter((row["style"], row["role"], row["camera"]) for row in rows if row["style"] == "vqa")
    if any(count > 1 for count in pairs.values()):
        yield "one question and answer per camera", "several"
