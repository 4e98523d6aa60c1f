"""Scores of answers, with values worked out by hand."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
from question_examples import make_question, write_folder

from robocas_ms3.cli.main import run
from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.evaluation.removal_questions.question_files import check_protocol_of
from robocas_ms3.evaluation.removal_questions.scores import (
    compute_chance,
    make_answers,
    read_answers,
    score_answers,
    score_rules,
)
from robocas_ms3.evaluation.results.outcomes import MovedObject, Retrieval

QUESTIONS = [
    make_question(0, [1, 2], objects=4, highest=1, scripted=2),  # chance 1/2, in the middle: 2
    make_question(1, [3], objects=4, highest=1, scripted=None),  # chance 1/4, in the middle: 2
    make_question(2, [5], objects=10, removals=3, highest=5, scripted=4),  # chance 1/10, in the middle: 5
]


def test_answers_are_correct_if_they_are_among_those_of_the_question():
    score = score_answers("model", QUESTIONS, {0: 2, 1: None, 2: 5})
    assert (score.accuracy.k, score.accuracy.n) == (2, 3)
    assert {removals: (rate.k, rate.n) for removals, rate in score.by_removals.items()} == {1: (1, 2), 3: (1, 1)}
    assert score.accuracy.low == pytest.approx(0.0943, abs=1e-4)  # Clopper-Pearson, 2 of 3
    assert score.accuracy.high == pytest.approx(0.9916, abs=1e-4)


def test_rules_are_scored_like_answers():
    correct = {score.name.partition(" (")[0]: score.accuracy.k for score in score_rules(QUESTIONS)}
    assert correct == {"largest box": 1, "most central box": 2, "highest object": 2, "scripted policy": 1}


def test_rule_without_any_answer_is_left_out():
    assert len(score_rules(QUESTIONS[1:2])) == 3


def test_questions_without_an_answer_are_also_left_out():
    score = score_answers("model", QUESTIONS, {0: 2, 1: None, 2: 4})
    assert score.answered is not None
    assert (score.accuracy.k, score.accuracy.n) == (1, 3)
    assert (score.answered.k, score.answered.n) == (1, 2)
    assert score_answers("silent", QUESTIONS, dict.fromkeys(range(3))).answered is None


def test_chance_is_the_mean_of_the_correct_fractions():
    assert compute_chance(QUESTIONS) == pytest.approx((1 / 2 + 1 / 4 + 1 / 10) / 3)


@pytest.mark.parametrize("answers", [{0: 1, 1: 1}, {0: 1, 1: 1, 2: 1, 7: 1}])
def test_missing_and_unknown_questions_are_errors(answers):
    with pytest.raises(EvaluationError):
        score_answers("model", QUESTIONS, answers)


def make_outcome(*moved: str, step: int = 1, retrieval: bool = True) -> Any:
    found = [MovedObject(name, place * step + 1, True, True) for place, name in enumerate(moved)]
    return SimpleNamespace(retrieval=Retrieval(found, [], 0, None) if retrieval else None)


@pytest.mark.parametrize(
    ("outcome", "answer"),
    [
        (make_outcome("object_3", "object_1"), 3),
        (make_outcome(), None),
        (make_outcome("target", "object_3"), None),  # it has no number
        (make_outcome("object_3", "object_1", step=0), None),  # at the same step
        (make_outcome(retrieval=False), None),  # an error ended the episode
    ],
)
def test_answer_of_a_policy_is_the_object_that_it_moved_first(outcome, answer):
    (found,) = make_answers(QUESTIONS[:1], {0: outcome, 9: make_outcome("object_1")})
    assert (found.episode, found.answer) == (0, answer)


def test_question_without_an_episode_is_an_error():
    with pytest.raises(EvaluationError):
        make_answers(QUESTIONS, {0: make_outcome(), 1: make_outcome()})


def test_results_of_another_protocol_have_no_answers(tmp_path):
    folder = write_folder(tmp_path / "questions", QUESTIONS, images=False)
    result: Any = SimpleNamespace(folder=tmp_path, run=SimpleNamespace(protocol="mine", protocol_hash="ab"))
    check_protocol_of(folder, result)
    result.run.protocol_hash = "cd"
    with pytest.raises(EvaluationError):
        check_protocol_of(folder, result)
    (folder / "questions.json").unlink()
    with pytest.raises(EvaluationError):
        check_protocol_of(folder, result)


@pytest.mark.parametrize(
    "text",
    [
        "",
        '{"episode": 0, "answer": "2"}\n',  # a text
        '{"episode": 0, "answer": true}\n',
        '{"episode": 0}\n',
        '{"episode": -1, "answer": 2}\n',
        '{"episode": 0, "answer": 0}\n',  # numbers start from 1
        '{"episode": 0, "answer": 1}\n{"episode": 0, "answer": 2}\n',  # twice
        "not json\n",
    ],
)
def test_damaged_answers_are_errors(tmp_path, text):
    (tmp_path / "answers.jsonl").write_text(text)
    with pytest.raises(EvaluationError):
        read_answers(tmp_path / "answers.jsonl")


def test_command_prints_the_scores_of_answers_and_rules(tmp_path, capsys):
    folder = write_folder(tmp_path / "questions", QUESTIONS, images=False)
    answers = tmp_path / "mine.jsonl"
    answers.write_text("".join(f'{{"episode": {episode}, "answer": 1}}\n' for episode in range(3)))
    assert run(["questions", "score", str(folder), str(answers)]) == 0
    rows = [line for line in capsys.readouterr().out.splitlines() if "mine" in line or "random object" in line]
    assert "33.3 (0.8 to 90.6)" in rows[0]
    assert "28.3" in rows[1]
