"""Scores of answers, with values worked out by hand."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
from question_examples import make_question, write_folder

from robocas_ms3.cli.main import run
from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.evaluation.outcomes import MovedObject, Retrieval
from robocas_ms3.evaluation.removal_questions.scores import (
    compute_chance,
    make_answers,
    read_answers,
    score_answers,
    score_rules,
)

QUESTIONS = [
    make_question(0, [1, 2], objects=4, highest=1, scripted=2),  # chance 1/2
    make_question(1, [3], objects=4, highest=1, scripted=None),  # chance 1/4
    make_question(2, [5], objects=10, removals=3, highest=5, scripted=4),  # chance 1/10
]
ANSWERS = {"heap-0": 2, "heap-1": None, "heap-2": 5}


def test_answers_are_right_if_they_are_among_the_true_ones():
    score = score_answers("model", QUESTIONS, ANSWERS)
    assert (score.accuracy.k, score.accuracy.n) == (2, 3)
    assert {removals: (rate.k, rate.n) for removals, rate in score.by_removals.items()} == {1: (1, 2), 3: (1, 1)}
    assert score.accuracy.low == pytest.approx(0.0943, abs=1e-4)  # Clopper-Pearson, 2 of 3
    assert score.accuracy.high == pytest.approx(0.9916, abs=1e-4)


def test_rules_are_scored_like_answers():
    assert {score.name: score.accuracy.k for score in score_rules(QUESTIONS)} == {
        "highest object": 2,
        "scripted policy": 1,
    }


def test_chance_is_the_mean_of_the_right_fractions():
    assert compute_chance(QUESTIONS) == pytest.approx((1 / 2 + 1 / 4 + 1 / 10) / 3)


def test_missing_answer_is_an_error():
    with pytest.raises(EvaluationError, match="heap-2"):
        score_answers("model", QUESTIONS, {"heap-0": 1, "heap-1": 1})


def make_outcome(seed: int, *moved: str, retrieval: bool = True) -> Any:
    found = [MovedObject(name, step, True, True) for step, name in enumerate(moved, 1)]
    return SimpleNamespace(seed=seed, retrieval=Retrieval(found, [], 0, None) if retrieval else None)


def test_answer_of_a_policy_is_the_object_that_it_moved_first():
    outcomes = [
        make_outcome(2, "object_5", "object_1"),
        make_outcome(0),
        make_outcome(1, "target", "object_3"),  # it has no number
        make_outcome(9, "object_1"),  # another scene
    ]
    answers = make_answers(QUESTIONS, outcomes)
    assert [(one.id, one.answer) for one in answers] == [("heap-0", None), ("heap-1", None), ("heap-2", 5)]


def test_question_without_an_episode_of_search_is_an_error():
    outcomes = [make_outcome(0), make_outcome(1), make_outcome(2, retrieval=False)]
    with pytest.raises(EvaluationError, match="1 of 3"):
        make_answers(QUESTIONS, outcomes)


@pytest.mark.parametrize(
    "text",
    [
        "",
        '{"id": "heap-0", "answer": "2"}\n',  # a text
        '{"id": "heap-0", "answer": true}\n',
        '{"id": "heap-0"}\n',
        '{"id": "heap-0", "answer": 1}\n{"id": "heap-0", "answer": 2}\n',  # twice
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
    answers.write_text("".join(f'{{"id": "heap-{seed}", "answer": 1}}\n' for seed in range(3)))
    assert run(["questions", "score", str(answers), "--questions", str(folder)]) == 0
    rows = [line for line in capsys.readouterr().out.splitlines() if "mine" in line or "random object" in line]
    assert "33.3%" in rows[0]
    assert "28.3% (expected)" in rows[1]
