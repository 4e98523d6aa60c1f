"""Questions: reading, making, rendering again, and continuing after an interruption."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from question_examples import make_question, write_folder

from robocas_ms3.core.errors import EvaluationError, OutputExistsError
from robocas_ms3.core.json_lines import JsonLinesFile
from robocas_ms3.datasets.images.image_files import read_image
from robocas_ms3.demos.difficulty.records import SceneDifficulty
from robocas_ms3.evaluation.protocols.bundled_protocols import bundled_protocols
from robocas_ms3.evaluation.protocols.protocol import load_protocol
from robocas_ms3.evaluation.protocols.scene_difficulties import DIFFICULTIES
from robocas_ms3.evaluation.removal_questions.question_files import QUESTIONS, make_questions, read_questions
from robocas_ms3.evaluation.removal_questions.question_renderer import SIZE

PICK, OTHER_PICK = 0, 1  # episodes of the protocol smoke


def test_questions_are_read_as_they_were_written(tmp_path):
    questions = [make_question(1, [2]), make_question(2, [1, 3], removals=2)]
    assert read_questions(write_folder(tmp_path / "set", questions)) == questions


@pytest.mark.parametrize(
    "changes",
    [
        {"answers": [2, 2]},
        {"answers": []},
        {"answers": [5]},
        {"answers": [1, 2, 3, 4]},  # all are correct
        {"answers": [3, 1]},
        {"highest": 5},
        {"scripted": 0},
        {"objects": []},
        {"image": "../secret.png"},
        {"image": "images/000002.png"},  # of another episode
        {"removals": 0},
        {"episode": -1},
    ],
    ids=str,
)
def test_inconsistent_questions_are_errors(tmp_path, changes):
    folder = write_folder(tmp_path / "set", [make_question(1, [2])], images=False)
    line = asdict(make_question(1, [2])) | changes
    (folder / QUESTIONS).write_text(json.dumps(line) + "\n")
    with pytest.raises(EvaluationError):
        read_questions(folder)


def test_missing_files_and_repeated_questions_are_errors(tmp_path):
    with pytest.raises(EvaluationError):
        read_questions(tmp_path)
    with pytest.raises(EvaluationError):
        read_questions("smoke")  # a protocol without questions
    folder = write_folder(tmp_path / "set", 2 * [make_question(1, [2])], images=False)
    with pytest.raises(EvaluationError):
        read_questions(folder)


def make_scene(episode, removals: int, first: list[int], **values: object) -> SceneDifficulty:
    scene = SceneDifficulty(episode.seed, episode.target, 5, 1.0, 0, 1, 0, 0.1, removals, first, None, 1, True)
    return replace(scene, **values)


@pytest.fixture
def protocol(tmp_path: Path) -> Path:
    """A copy of smoke: each object first, an incomplete search, slots 0 and 1 first, and nothing to remove."""
    folder = tmp_path / "mine"
    shutil.copytree(bundled_protocols()["smoke"], folder)
    episodes = load_protocol(folder).episodes
    scenes = [make_scene(episode, 0, []) for episode in episodes]
    scenes[PICK] = make_scene(episodes[PICK], 2, [0, 1])
    scenes[OTHER_PICK] = make_scene(episodes[OTHER_PICK], 1, list(range(20)))
    scenes[4] = make_scene(episodes[4], 1, [0, 1], complete=False)
    JsonLinesFile(folder / DIFFICULTIES, SceneDifficulty).rewrite(scenes)
    return folder


def test_questions_need_difficulties_or_questions(tmp_path):
    with pytest.raises(EvaluationError):
        make_questions(load_protocol("smoke"), tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("question", [make_question(99, [1]), make_question(0, [1])])
def test_questions_of_another_protocol_are_errors(protocol, tmp_path, question):
    JsonLinesFile(protocol / QUESTIONS, type(question)).rewrite([question])
    with pytest.raises(EvaluationError):
        make_questions(load_protocol(protocol), tmp_path / "out")


@pytest.mark.slow
@pytest.mark.usefixtures("needs_renderer")
def test_questions_are_made_continued_and_rendered_again(protocol, tmp_path):
    loaded, out, calls = load_protocol(protocol), tmp_path / "questions", list[tuple[int, int]]()
    (question,) = make_questions(loaded, out, on_scenes=lambda *counts: calls.append(counts))
    assert calls == [(0, 3), (1, 3), (2, 3), (3, 3)]  # scenes without removals are not rendered
    assert (question.episode, question.removals) == (PICK, 2)
    assert question.instruction == loaded.episodes[PICK].instruction
    slots = {numbered.number: numbered.slot for numbered in question.objects}
    assert {slots[number] for number in question.answers} == {0, 1} & set(slots.values())
    assert loaded.episodes[PICK].target not in {numbered.asset for numbered in question.objects}
    image = read_image(out / question.image)
    assert image.shape == (SIZE[1], SIZE[0], 3)
    assert [path.name for path in (out / "images").iterdir()] == ["000000.png"]

    (out / "rendered.jsonl").write_text("1\n")  # as if the process had been killed after it wrote the question
    assert make_questions(loaded, out, on_scenes=lambda *counts: calls.append(counts)) == [question]
    assert calls[4] == (1, 3)
    assert read_questions(out) == [question]

    (out / question.image).unlink()
    assert make_questions(loaded, out) == [question]
    assert np.array_equal(read_image(out / question.image), image)

    JsonLinesFile(protocol / QUESTIONS, type(question)).rewrite([question])
    with pytest.raises(OutputExistsError):
        make_questions(loaded, out)  # they may differ from those in the folder
    assert make_questions(loaded, tmp_path / "again") == [question]
    assert np.array_equal(read_image(tmp_path / "again" / question.image), image)

    other = replace(question, objects=[replace(question.objects[0], asset="mug"), *question.objects[1:]])
    JsonLinesFile(protocol / QUESTIONS, type(question)).rewrite([other])
    with pytest.raises(EvaluationError):
        make_questions(loaded, tmp_path / "other")
