"""Scores of answers: the fraction of questions with a right answer, and the scores of simple rules."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.core.json_lines import JsonLinesFile
from robocas_ms3.evaluation.outcomes import Outcome
from robocas_ms3.evaluation.removal_questions.records import Answer, RemovalQuestion
from robocas_ms3.evaluation.statistics import SuccessRate, compute_success_rate

RULES: Mapping[str, Callable[[RemovalQuestion], int | None]] = {
    "highest object": lambda question: question.highest,
    "scripted policy": lambda question: question.scripted,
}
"""Answers of simple rules that know the state of the simulator, by name."""


@dataclass(frozen=True)
class AnswerScore:
    """Score of the answers of a model or rule.

    Attributes:
        name: name of the model or rule.
        accuracy: right answers of all questions.
        by_removals: the same for the questions with each number of removals.
    """

    name: str
    accuracy: SuccessRate
    by_removals: dict[int, SuccessRate]


def score_answers(name: str, questions: Sequence[RemovalQuestion], answers: Mapping[str, int | None]) -> AnswerScore:
    """Score answers to questions.

    Args:
        name: name of the model or rule.
        questions: the questions.
        answers: number of an object, or None for no answer, by the id of the question.

    Raises:
        EvaluationError: a question has no entry in ``answers``.
    """
    if missing := [question.id for question in questions if question.id not in answers]:
        what, fix = f"{len(missing)} of {len(questions)} questions have no line", 'Write "answer": null for no answer.'
        raise EvaluationError(what, expected="one line per question", found=f"no line for {missing[0]}", fix=fix)
    right = {question.id: answers[question.id] in question.answers for question in questions}
    by_removals = {
        removals: compute_success_rate(sum(right[one.id] for one in of), len(of))
        for removals in sorted({question.removals for question in questions})
        if (of := [question for question in questions if question.removals == removals])
    }
    return AnswerScore(name, compute_success_rate(sum(right.values()), len(questions)), by_removals)


def score_rules(questions: Sequence[RemovalQuestion]) -> list[AnswerScore]:
    """Score the answers of all `RULES`."""
    return [
        score_answers(name, questions, {question.id: rule(question) for question in questions})
        for name, rule in RULES.items()
    ]


def compute_chance(questions: Sequence[RemovalQuestion]) -> float:
    """Return the expected accuracy of a random choice among the numbered objects."""
    return sum(len(question.answers) / len(question.objects) for question in questions) / len(questions)


def make_answers(questions: Sequence[RemovalQuestion], outcomes: Iterable[Outcome]) -> list[Answer]:
    """Return the answers of a policy that was evaluated in the scenes: the object that it moved first.

    There is no answer if the policy moved no object before it held the target, or an object without a number.

    Args:
        questions: questions with different seeds.
        outcomes: outcomes of episodes of search; those of other scenes are ignored.

    Raises:
        EvaluationError: a question has no episode.
    """
    first = {
        outcome.seed: outcome.retrieval.moved[0].object if outcome.retrieval.moved else ""
        for outcome in outcomes
        if outcome.retrieval is not None
    }
    if missing := [question.seed for question in questions if question.seed not in first]:
        what, found = f"{len(missing)} of {len(questions)} questions have no episode", f"none with seed {missing[0]}"
        raise EvaluationError(what, expected="an episode of search in each scene", found=found)
    numbers = {question.id: {one.asset: one.number for one in question.objects} for question in questions}
    return [Answer(question.id, numbers[question.id].get(first[question.seed])) for question in questions]


def read_answers(path: Path) -> dict[str, int | None]:
    """Read a JSON Lines file with one `Answer` per line.

    Raises:
        EvaluationError: there is no such file, a line is damaged, or a question has several lines.
    """
    file = JsonLinesFile[Answer](path, Answer)
    lines = file.read_lines()
    if not lines:
        expected = 'a file with lines such as {"id": "search_large-290001", "answer": 3}'
        raise EvaluationError("no answers", where=path, expected=expected, usage=True)
    found: dict[str, int | None] = {}
    for line in lines:
        if line.record is None:
            raise file.make_line_error(line, EvaluationError, "damaged answer")
        if line.record.id in found:
            raise EvaluationError("two answers to one question", where=f"{path}:{line.number}", found=line.record.id)
        found[line.record.id] = line.record.answer
    return found
