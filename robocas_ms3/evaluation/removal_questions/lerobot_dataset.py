"""Write questions as a LeRobot dataset: one episode with one frame per question, and ``vqa`` rows."""

from __future__ import annotations

import json
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from robocas_ms3.core.files import atomic_folder, write_json
from robocas_ms3.core.output_folder import check_replaceable
from robocas_ms3.datasets.images.image_files import read_image
from robocas_ms3.datasets.lerobot import schema
from robocas_ms3.datasets.lerobot.language import (
    EVENTS,
    EVENTS_TYPE,
    PERSISTENT,
    PERSISTENT_TYPE,
    Row,
    make_vqa_rows,
)
from robocas_ms3.datasets.lerobot.stats import LevelHistogram, compute_stats
from robocas_ms3.datasets.lerobot.tables import write_texts
from robocas_ms3.datasets.lerobot.variants import V3
from robocas_ms3.datasets.lerobot.writer import RollingTableWriter
from robocas_ms3.evaluation.removal_questions.question_files import QuestionSet
from robocas_ms3.evaluation.removal_questions.records import RemovalQuestion

CAMERA = "question_camera"
_FPS = 1  # LeRobot requires a rate
_LIMITS = schema.FileLimits()
_IMAGE_TYPE = pa.struct([pa.field("bytes", pa.binary()), pa.field("path", pa.string())])  # datasets.Image


def write_lerobot(questions: QuestionSet, out: Path, *, overwrite: bool = False) -> None:
    """Write rendered questions as a LeRobot dataset for LeRobot 0.6 and later.

    Args:
        questions: questions whose images were rendered.
        out: folder of the dataset.
        overwrite: whether to replace an existing dataset.

    Raises:
        EvaluationError: an image is missing.
        OutputExistsError: ``out`` exists.
        MissingExtraError: the extra ``lerobot`` is not installed.
    """
    schema.require_lerobot()
    check_replaceable(out, overwrite=overwrite, markers=(schema.INFO_FILE,))
    for question in questions.questions:
        questions.find_image(question)
    with atomic_folder(out) as folder:
        tasks = list(dict.fromkeys(question.instruction for question in questions.questions))
        key = schema.image_key(CAMERA)
        levels, numbers = LevelHistogram.make_rgb(), _number_frames(questions.questions, tasks)
        data = RollingTableWriter(partial(V3.file_path, folder, "data"), _LIMITS.data_mb)
        episodes = RollingTableWriter(partial(V3.file_path, folder, "meta/episodes"), _LIMITS.data_mb, group=1000)
        size = (0, 0)
        with closing(data), closing(episodes):
            for index, question in enumerate(questions.questions):
                path = questions.find_image(question)
                image = read_image(path)
                levels.add(image)
                size = image.shape[:2]
                chunk, file = data.next_file(path.stat().st_size)
                data.add(_make_frame(question, path, {name: values[index] for name, values in numbers.items()}))
                places = {"data/chunk_index": chunk, "data/file_index": file}
                episodes.add(_make_episode(index, question, places, dict(zip(*_place(episodes), strict=True))))
        write_texts(folder / schema.TASKS_FILE, "task_index", tasks)
        stats = {name: compute_stats(values[:, None]) for name, values in numbers.items()}
        write_json(folder / schema.STATS_FILE, stats | {key: levels.stats()})
        write_json(folder / schema.INFO_FILE, _make_info(len(questions.questions), len(tasks), key, size))


def _number_frames(questions: list[RemovalQuestion], tasks: list[str]) -> dict[str, np.ndarray]:
    """Return the index features (Q,) of Q questions by key."""
    indices = np.arange(len(questions))
    places = {text: place for place, text in enumerate(tasks)}
    return {
        "timestamp": np.zeros(len(questions), np.float32),
        "frame_index": np.zeros(len(questions), np.int64),
        "episode_index": indices,
        "index": indices,
        "task_index": np.array([places[question.instruction] for question in questions], np.int64),
    }


def make_question_rows(question: RemovalQuestion) -> list[Row]:
    """Make the ``language_events`` rows of a question: the question, and its answer as JSON."""
    answer = json.dumps({"answers": question.answers})
    return make_vqa_rows(question.question, answer, schema.image_key(CAMERA))


def _make_frame(question: RemovalQuestion, path: Path, numbers: dict[str, Any]) -> pa.Table:
    image = [{"bytes": path.read_bytes(), "path": path.name}]
    columns = {name: pa.array([value]) for name, value in numbers.items()}
    columns[schema.image_key(CAMERA)] = pa.array(image, _IMAGE_TYPE)
    columns[PERSISTENT] = pa.array([[]], PERSISTENT_TYPE)
    columns[EVENTS] = pa.array([make_question_rows(question)], EVENTS_TYPE)
    return pa.table(columns)


def _make_episode(index: int, question: RemovalQuestion, *places: dict[str, int]) -> pa.Table:
    row: dict[str, Any] = {
        "episode_index": index,
        "tasks": [question.instruction],
        "length": 1,
        "dataset_from_index": index,
        "dataset_to_index": index + 1,
    }
    for found in places:
        row |= found
    return pa.Table.from_pylist([row])


def _place(episodes: RollingTableWriter) -> tuple[tuple[str, str], tuple[int, int]]:
    return ("meta/episodes/chunk_index", "meta/episodes/file_index"), episodes.next_file()


def _make_info(count: int, tasks: int, key: str, size: tuple[int, ...]) -> dict[str, Any]:
    image = {"dtype": "image", "shape": [*size, 3], "names": ["height", "width", "channels"]}
    language = [schema.Feature(name, dtype="language") for name in schema.LANGUAGE_COLUMNS]
    indices = [schema.Feature(name, dtype="float32" if name == "timestamp" else "int64") for name in schema.INDICES]
    return {
        "codebase_version": V3.codebase_version,
        "robot_type": schema.ROBOT_TYPE,
        "total_episodes": count,
        "total_frames": count,
        "total_tasks": tasks,
        "chunks_size": 1000,
        "data_files_size_in_mb": _LIMITS.data_mb,
        "video_files_size_in_mb": _LIMITS.video_mb,
        "fps": _FPS,
        "splits": {"test": f"0:{count}"},
        "data_path": V3.data,
        "video_path": None,
        "features": {key: image, **{feature.key: feature.as_json() for feature in (*language, *indices)}},
    }
