"""Scores of answers: the fraction of questions with a correct answer, and the scores of simple rules."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.core.json_lines import JsonLinesFile
from robocas_ms3.datasets.images.image_files import Box
from robocas_ms3.evaluation.removal_questions.records import Answer, RemovalQuestion
from robocas_ms3.evaluation.results.outcomes import Outcome
from robocas_ms3.evaluation.statistics import SuccessRate, compute_success_rate


def _measure_area(box: Box) -> int:
    return (box[2] - box[0] + 1) * (box[3] - box[1] + 1)


def _choose_central_object(question: RemovalQuestion) -> int:
    """Return the number of the object whose box is nearest to the middle of all boxes."""
    centers = (
        np.array([[box[0] + box[2], box[1] + box[3]] for box in (numbered.box for numbered in question.objects)]) / 2
    )
    distances = np.linalg.norm(centers - np.median(centers, axis=0), axis=1)
    return question.objects[int(distances.argmin())].number


RULES: Mapping[str, Callable[[RemovalQuestion], int | None]] = {
    "largest box": lambda question: max(question.objects, key=lambda numbered: _measure_area(numbered.box)).number,
    "most central box": _choose_central_object,
    "highest object (from the state)": lambda question: question.highest,
    "scripted policy (from the state)": lambda question: question.scripted,
}
"""Answers of simple rules, by name. Some know the state of the simulator."""


@dataclass(frozen=True)
class AnswerScore:
    """Score of the answers of a model or rule.

    Attributes:
        name: name of the model or rule.
        accuracy: correct answers of all questions; a question without an answer counts as wrong.
        answered: correct answers of the questions with an answer; None: there is no answer.
        by_removals: correct answers of the questions with each number of removals.
    """

    name: str
    accuracy: SuccessRate
    answered: SuccessRate | None
    by_removals: dict[int, SuccessRate]


def score_answers(name: str, questions: Sequence[RemovalQuestion], answers: Mapping[int, int | None]) -> AnswerScore:
    """Score answers to questions.

    Args:
        name: name of the model or rule, for the score and for errors.
        questions: the questions.
        answers: number of an object, or None for no answer, by the episode of the question.

    Raises:
        EvaluationError: a question has no entry in ``answers``, or an entry belongs to no question.
    """
    episodes = {question.episode for question in questions}
    if missing := sorted(episodes - answers.keys()):
        what, fix = f"{len(missing)} of {len(questions)} questions have no line", 'Write "answer": null for no answer.'
        found = f"no line for episode {missing[0]}"
        raise EvaluationError(what, where=name, expected="one line per question", found=found, fix=fix)
    if unknown := sorted(answers.keys() - episodes):
        what = "answer to an unknown question"
        raise EvaluationError(what, where=name, expected="episodes of the questions", found=f"episode {unknown[0]}")
    is_correct = {question.episode: answers[question.episode] in question.answers for question in questions}
    groups: dict[int, list[bool]] = {}
    for question in sorted(questions, key=lambda question: question.removals):
        groups.setdefault(question.removals, []).append(is_correct[question.episode])
    by_removals = {removals: compute_success_rate(sum(group), len(group)) for removals, group in groups.items()}
    correct, answered = sum(is_correct.values()), sum(number is not None for number in answers.values())
    of_answered = compute_success_rate(correct, answered) if answered else None
    return AnswerScore(name, compute_success_rate(correct, len(questions)), of_answered, by_removals)


def score_rules(questions: Sequence[RemovalQuestion]) -> list[AnswerScore]:
    """Score the answers of all `RULES`; a rule without any answer is left out."""
    scores = [
        score_answers(name, questions, {question.episode: rule(question) for question in questions})
        for name, rule in RULES.items()
    ]
    return [score for score in scores if score.answered is not None]


def compute_chance(questions: Sequence[RemovalQuestion]) -> float:
    """Return the expected accuracy of a random choice among the numbered objects."""
    return sum(len(question.answers) / len(question.objects) for question in questions) / len(questions)


def make_answers(questions: Sequence[RemovalQuestion], outcomes: Mapping[int, Outcome]) -> list[Answer]:
    """Return the answers of a policy that was evaluated on the protocol: the object that it moved first.

    There is no answer if the policy moved no object before it held the target, several objects at the same step, or an
    object without a number, or if an error ended the episode.

    Args:
        questions: questions about the scenes of the protocol.
        outcomes: outcomes of its episodes, by number of the episode.

    Raises:
        EvaluationError: a question has no outcome.
    """
    if missing := [question.episode for question in questions if question.episode not in outcomes]:
        what, found = f"{len(missing)} of {len(questions)} questions have no episode", f"no episode {missing[0]}"
        raise EvaluationError(what, expected="an outcome of each scene", found=found)
    return [Answer(question.episode, _find_first_move(question, outcomes[question.episode])) for question in questions]


def _find_first_move(question: RemovalQuestion, outcome: Outcome) -> int | None:
    moved = outcome.retrieval.moved if outcome.retrieval is not None else []
    first = [move.object for move in moved if move.step == moved[0].step]
    numbers = [numbered.number for numbered in question.objects if numbered.asset in first]
    return numbers[0] if len(first) == len(numbers) == 1 else None


def read_answers(path: Path) -> dict[int, int | None]:
    """Read a JSON Lines file with one `Answer` per line.

    Raises:
        EvaluationError: there is no such file, a line is damaged, or a question has several lines.
    """
    file = JsonLinesFile[Answer](path, Answer)
    lines = file.read_lines()
    if not lines:
        expected = 'a file with lines such as {"episode": 12, "answer": 3}'
        raise EvaluationError("no answers", where=path, expected=expected, usage=True)
    answers: dict[int, int | None] = {}
    for line in lines:
        if line.record is None:
            raise file.make_line_error(line, EvaluationError, "damaged answer")
        if line.record.episode in answers:
            where, found = f"{path}:{line.number}", f"episode {line.record.episode}"
            raise EvaluationError("two answers to one question", where=where, found=found)
        answers[line.record.episode] = line.record.answer
    return answers
