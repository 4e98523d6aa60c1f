"""Questions as a LeRobot dataset."""

from __future__ import annotations

import json

import pytest

pytest.importorskip("pyarrow")
pytest.importorskip("av")

import numpy as np
import pyarrow.parquet as pq
from question_examples import make_question, write_folder

from robocas_ms3.core.errors import EvaluationError, OutputExistsError
from robocas_ms3.datasets.images.image_files import write_image
from robocas_ms3.evaluation.removal_questions.lerobot_dataset import write_lerobot

KEY = "observation.images.question_camera"


def test_dataset_has_one_frame_with_image_question_and_answer_per_question(tmp_path):
    questions = [make_question(1, [2]), make_question(2, [1, 3]), make_question(3, [4])]
    folder = write_folder(tmp_path / "set", questions)
    write_lerobot(questions, folder, tmp_path / "lerobot")
    info = json.loads((tmp_path / "lerobot/meta/info.json").read_text())
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (3, 3, 2)
    assert info["features"][KEY]["dtype"] == "image"
    assert info["features"][KEY]["shape"] == [24, 32, 3]
    rows = pq.read_table(tmp_path / "lerobot/data").to_pylist()
    assert set(rows[0]) == set(info["features"])
    for row, question in zip(rows, questions, strict=True):
        assert row[KEY]["bytes"] == (folder / question.image).read_bytes()
        asked, answered = row["language_events"]
        assert (asked["role"], asked["style"], asked["camera"]) == ("user", "vqa", KEY)
        assert asked["content"] == question.question
        assert (answered["role"], json.loads(answered["content"])) == ("assistant", {"answers": question.answers})
    assert [row["task_index"] for row in rows] == [0, 1, 0]
    episodes = pq.read_table(tmp_path / "lerobot/meta/episodes").to_pylist()
    assert [(row["dataset_from_index"], row["dataset_to_index"]) for row in episodes] == [(0, 1), (1, 2), (2, 3)]
    stats = json.loads((tmp_path / "lerobot/meta/stats.json").read_text())
    assert stats[KEY]["max"][0] == [[pytest.approx(20 / 255)]]


def test_missing_image_leaves_no_dataset(tmp_path):
    questions = [make_question(1, [2]), make_question(2, [1])]
    folder = write_folder(tmp_path / "set", questions)
    (folder / questions[1].image).unlink()
    with pytest.raises(EvaluationError):
        write_lerobot(questions, folder, tmp_path / "lerobot")
    write_image(folder / questions[1].image, np.zeros((9, 9, 3), np.uint8))  # another size
    with pytest.raises(EvaluationError):
        write_lerobot(questions, folder, tmp_path / "lerobot")
    assert not (tmp_path / "lerobot").exists()


def test_existing_folder_is_replaced_only_if_it_is_a_dataset(tmp_path):
    questions = [make_question(1, [2])]
    folder = write_folder(tmp_path / "set", questions)
    write_lerobot(questions, folder, tmp_path / "lerobot")
    with pytest.raises(OutputExistsError):
        write_lerobot(questions, folder, tmp_path / "lerobot")
    write_lerobot(questions, folder, tmp_path / "lerobot", overwrite=True)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/file").write_text("")
    with pytest.raises(OutputExistsError):
        write_lerobot(questions, folder, tmp_path / "mine", overwrite=True)
