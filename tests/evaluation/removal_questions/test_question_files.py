"""Sets of questions: reading, making, rendering, and continuing after an interruption."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from question_examples import make_question, write_folder

from robocas_ms3.core.errors import EvaluationError, OutputExistsError
from robocas_ms3.core.json_lines import JsonLinesFile
from robocas_ms3.datasets.images.image_files import read_image
from robocas_ms3.demos.difficulty.difficulty_file import OUTPUT, SCENES
from robocas_ms3.demos.difficulty.records import SceneDifficulty
from robocas_ms3.evaluation.removal_questions.question_files import (
    bundled_question_sets,
    make_questions,
    read_question_set,
    render_questions,
)
from robocas_ms3.evaluation.removal_questions.question_renderer import SIZE
from robocas_ms3.scenes.config import load_task_config

SEEDS = [985500, 985501]


def test_questions_are_read_as_they_were_written(tmp_path):
    questions = [make_question(1, [2]), make_question(2, [1, 3], removals=2)]
    found = read_question_set(write_folder(tmp_path / "set", questions))
    assert found.questions == questions
    assert found.scenes["heap"].config == "search_table_stacked"
    assert found.find_image(questions[0]).is_file()


@pytest.mark.parametrize(
    "change",
    [
        lambda folder: (folder / "questions.json").unlink(),
        lambda folder: (folder / "questions.json").write_text('{"scenes": {"heap": {"task": 3}}}'),
        lambda folder: (folder / "questions.jsonl").write_text('{"id": "heap-1"}\n'),
        lambda folder: (folder / "questions.jsonl").write_text(2 * (folder / "questions.jsonl").read_text()),
        lambda folder: (folder / "questions.jsonl").unlink(),
    ],
)
def test_damaged_sets_are_errors(tmp_path, change):
    folder = write_folder(tmp_path / "set", [make_question(1, [2])])
    change(folder)
    with pytest.raises(EvaluationError):
        read_question_set(folder)


def test_path_of_an_image_is_not_taken_from_the_file(tmp_path):
    """A file may not choose which file is read."""
    (tmp_path / "secret.png").write_bytes(b"")
    question = replace(make_question(1, [2]), image="../secret.png")
    with pytest.raises(EvaluationError):
        read_question_set(write_folder(tmp_path / "set", [question], images=False)).find_image(question)


@pytest.mark.parametrize("name", sorted(bundled_question_sets()))
def test_bundled_questions_are_consistent(name):
    found = read_question_set(name)
    for question in found.questions:
        numbers = [one.number for one in question.objects]
        assert numbers == list(range(1, len(numbers) + 1))
        assert set(question.answers) < set(numbers)
        assert {question.highest, question.scripted} <= {*numbers, None}
        assert question.id == f"{question.id.rpartition('-')[0]}-{question.seed}"
        assert question.id.rpartition("-")[0] in found.scenes
        assert all(
            0 <= one.box[0] <= one.box[2] < SIZE[0] and 0 <= one.box[1] <= one.box[3] < SIZE[1]
            for one in question.objects
        )


def write_difficulties(folder, scenes):
    config = load_task_config("pick_table_scattered", set_options=["objects.count=5"]).model_dump(mode="json")
    folder.mkdir()
    record = {"task": "pick", "config": config, "pack": "builtin", "limits": {"max_removals": 1, "max_simulated": 4}}
    (folder / OUTPUT.records[0]).write_text(json.dumps(record))
    JsonLinesFile(folder / SCENES, SceneDifficulty).rewrite(scenes)
    return folder


def make_scene(seed: int, removals: int, first: list[int]) -> SceneDifficulty:
    return SceneDifficulty(seed, "mug", 5, 1.0, 0, 1, 0, 0.1, removals, first, None, 1, True)


@pytest.mark.slow
@pytest.mark.usefixtures("needs_renderer")
def test_questions_are_made_rendered_again_and_continued(tmp_path):
    scenes = [make_scene(SEEDS[0], 1, [0, 1, 2, 3, 4]), make_scene(SEEDS[1], 2, [0, 1]), make_scene(7, 0, [])]
    source = write_difficulties(tmp_path / "table", scenes)
    calls: list[tuple[int, int]] = []
    out = tmp_path / "questions"
    make_questions([source], out, on_scenes=lambda *counts: calls.append(counts))
    assert calls[0] == (0, 2)  # a scene without removals is not rendered
    found = read_question_set(out)
    (question,) = found.questions  # none about the first scene, where each number is right
    assert question.seed == SEEDS[1]
    slots = {one.number: one.slot for one in question.objects}
    assert len(slots) == 4  # five objects without the target
    assert {slots[number] for number in question.answers} == {0, 1} & set(slots.values())
    assert question.removals == 2
    assert "images/" + found.find_image(question).name == question.image
    image = read_image(found.find_image(question))
    assert image.shape == (SIZE[1], SIZE[0], 3)

    assert make_questions([source], out, on_scenes=lambda *counts: calls.append(counts)) == 1
    assert calls[-1] == (2, 2)  # nothing is rendered again
    with pytest.raises(OutputExistsError):
        make_questions([write_difficulties(tmp_path / "other", scenes)], out)

    again = tmp_path / "again"
    render_questions(found, again)
    assert np.array_equal(read_image(again / question.image), image)
    assert read_question_set(again).questions == found.questions

    changed = replace(found, questions=[replace(question, instruction="another task")])
    with pytest.raises(EvaluationError):
        render_questions(changed, tmp_path / "changed")
