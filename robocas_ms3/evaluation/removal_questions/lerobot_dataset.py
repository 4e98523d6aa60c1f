"""Write questions as a LeRobot dataset: one episode with one frame per question, and ``vqa`` rows."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from robocas_ms3.core.errors import EvaluationError
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
from robocas_ms3.datasets.lerobot.variants import CHUNK_FILES, V3
from robocas_ms3.datasets.lerobot.writer import RollingTableWriter
from robocas_ms3.evaluation.removal_questions.records import RemovalQuestion

CAMERA = "question_camera"
_IMAGE_KEY = schema.image_key(CAMERA)
_FPS = 1  # LeRobot requires a rate
_LIMITS = schema.FileLimits()
_GROUP = 1000  # episodes per row group
_IMAGE_TYPE = pa.struct([pa.field("bytes", pa.binary()), pa.field("path", pa.string())])  # datasets.Image


def write_lerobot(questions: Sequence[RemovalQuestion], folder: Path, out: Path, *, overwrite: bool = False) -> None:
    """Write questions as a LeRobot dataset for LeRobot 0.6 and later.

    Args:
        questions: the questions.
        folder: folder of their images.
        out: folder of the dataset.
        overwrite: whether to replace an existing dataset.

    Raises:
        EvaluationError: an image is missing, or has another size than the first.
        OutputExistsError: ``out`` exists.
        MissingExtraError: the extra ``lerobot`` is not installed.
    """
    schema.require_lerobot()
    check_replaceable(out, overwrite=overwrite, markers=(schema.INFO_FILE,))
    if missing := [folder / question.image for question in questions if not (folder / question.image).is_file()]:
        fix = "Run robocas questions make again."
        raise EvaluationError("the image of a question is missing", where=missing[0], fix=fix)
    tasks = list(dict.fromkeys(question.instruction for question in questions))
    numbers, levels = _number_frames(questions, tasks), LevelHistogram.make_rgb()
    with atomic_folder(out) as tmp:
        data = RollingTableWriter(partial(V3.file_path, tmp, "data"), _LIMITS.data_mb)
        episodes = RollingTableWriter(partial(V3.file_path, tmp, "meta/episodes"), _LIMITS.data_mb, _GROUP)
        size: tuple[int, ...] = ()
        with closing(data), closing(episodes):
            for index, question in enumerate(questions):
                path = folder / question.image
                image = read_image(path)
                size = size or image.shape
                if image.shape != size:
                    raise EvaluationError("image of another size", where=path, expected=size, found=image.shape)
                levels.add(image)
                data_file = data.next_file(path.stat().st_size)
                data.add(_make_frame(question, path, {name: values[[index]] for name, values in numbers.items()}))
                episodes.add(_make_episode(index, question, data_file, episodes.next_file()))
        write_texts(tmp / schema.TASKS_FILE, "task_index", tasks)
        stats = {name: compute_stats(values[:, None]) for name, values in numbers.items()}
        write_json(tmp / schema.STATS_FILE, stats | {_IMAGE_KEY: levels.stats()})
        write_json(tmp / schema.INFO_FILE, _make_info(len(questions), len(tasks), size))


def make_question_rows(question: RemovalQuestion) -> list[Row]:
    """Make the ``language_events`` rows of a question: the question, and the correct answers as JSON."""
    return make_vqa_rows(question.question, json.dumps({"answers": question.answers}), _IMAGE_KEY)


def _number_frames(questions: Sequence[RemovalQuestion], tasks: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Return the index features (Q,) of Q questions by key."""
    indices = np.arange(len(questions))
    return {
        "timestamp": np.zeros(len(questions), np.float32),
        "frame_index": np.zeros(len(questions), np.int64),
        "episode_index": indices,
        "index": indices,
        "task_index": np.array([tasks.index(question.instruction) for question in questions], np.int64),
    }


def _make_frame(question: RemovalQuestion, path: Path, numbers: dict[str, NDArray[Any]]) -> pa.Table:
    image = pa.array([{"bytes": path.read_bytes(), "path": path.name}], _IMAGE_TYPE)
    events = pa.array([make_question_rows(question)], EVENTS_TYPE)
    columns: dict[str, Any] = {_IMAGE_KEY: image, PERSISTENT: pa.array([[]], PERSISTENT_TYPE), EVENTS: events}
    return pa.table(columns | {name: pa.array(values) for name, values in numbers.items()})


def _make_episode(
    index: int, question: RemovalQuestion, data_file: tuple[int, int], episodes_file: tuple[int, int]
) -> pa.Table:
    row = {
        "episode_index": index,
        "tasks": [question.instruction],
        "length": 1,
        "dataset_from_index": index,
        "dataset_to_index": index + 1,
        "data/chunk_index": data_file[0],
        "data/file_index": data_file[1],
        "meta/episodes/chunk_index": episodes_file[0],
        "meta/episodes/file_index": episodes_file[1],
    }
    return pa.Table.from_pylist([row])


def _make_info(count: int, tasks: int, size: tuple[int, ...]) -> dict[str, Any]:
    image = {"dtype": "image", "shape": list(size), "names": ["height", "width", "channels"]}
    language = [schema.Feature(name, dtype="language") for name in schema.LANGUAGE_COLUMNS]
    indices = [schema.Feature(name, dtype="float32" if name == "timestamp" else "int64") for name in schema.INDICES]
    return {
        "codebase_version": V3.codebase_version,
        "robot_type": schema.ROBOT_TYPE,
        "total_episodes": count,
        "total_frames": count,
        "total_tasks": tasks,
        "chunks_size": CHUNK_FILES,
        "data_files_size_in_mb": _LIMITS.data_mb,
        "video_files_size_in_mb": _LIMITS.video_mb,
        "fps": _FPS,
        "splits": {"test": f"0:{count}"},
        "data_path": V3.data,
        "video_path": None,
        "features": {_IMAGE_KEY: image, **{feature.key: feature.as_json() for feature in (*language, *indices)}},
    }
