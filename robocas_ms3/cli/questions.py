"""``robocas questions``: make, render, convert and score questions about which object has to be removed first."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from robocas_ms3.cli.options import CORES, Folders, Jobs, resumable
from robocas_ms3.core.text import format_count

DESCRIPTION = "Questions about which object has to be removed first, for vision-language models."
_BUNDLED = "removal-order-v1"
_Set = Annotated[str, tyro.conf.arg(metavar="SET")]


@dataclass
class Make:
    """Make questions about measured scenes: questions.jsonl and images with numbered objects.

    A scene gives a question if an object has to be removed first, if such an object is visible, and if other numbered
    objects are wrong. After an interruption, the same command continues.

    Example: robocas questions make difficulty/search_table_stacked --out questions
    """

    folders: Folders
    """Output folders of robocas difficulty."""
    out: Path
    """Output folder."""
    jobs: Jobs = CORES
    """Number of processes that render. Default: one per CPU core."""
    overwrite: bool = False
    """Delete earlier results and start again. Default: continue."""


@dataclass
class Render:
    """Write a set of questions with its images. After an interruption, the same command continues.

    Example: robocas questions render --out questions
    """

    out: Path
    """Output folder."""
    questions: _Set = _BUNDLED
    """Bundled set of questions by name, or its folder."""
    jobs: Jobs = CORES
    """Number of processes that render. Default: one per CPU core."""
    overwrite: bool = False
    """Delete earlier results and start again. Default: continue."""


@dataclass
class Convert:
    """Convert rendered questions to a LeRobot dataset with `vqa` rows, for LeRobot 0.6 and later.

    Example: robocas questions convert questions --out questions_lerobot
    """

    questions: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """Folder of robocas questions render or make."""
    out: Path
    """Folder of the dataset."""
    overwrite: bool = False
    """Replace an existing dataset."""


@dataclass
class Answer:
    """Write the answers of a policy that was evaluated in the scenes of the questions: the object that it moved first.

    Example: robocas questions answer eval/keyframe --out keyframe.jsonl
    """

    folders: Folders
    """Folders of results; shards of one evaluation count as one result."""
    out: Path
    """File with the answers (JSON Lines)."""
    questions: _Set = _BUNDLED
    """Bundled set of questions by name, or its folder."""


@dataclass
class Score:
    """Score the answers of a model, next to those of simple rules.

    ANSWERS has one JSON object per line: {"id": "search_large-290001", "answer": 3}. The answer is the number of an
    object, or null for no answer. Without ANSWERS, only the rules are scored.

    Example: robocas questions score answers.jsonl
    """

    answers: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[ANSWERS ...]")] = ()
    """Files with answers (JSON Lines)."""
    questions: _Set = _BUNDLED
    """Bundled set of questions by name, or its folder."""


@resumable
def make(cfg: Make) -> int:
    from robocas_ms3.cli.progress import ProgressBar
    from robocas_ms3.cli.terminal import print_line
    from robocas_ms3.core.checks import check_number
    from robocas_ms3.evaluation.removal_questions.question_files import make_questions

    check_number("--jobs", cfg.jobs, 1)
    with ProgressBar("scenes rendered") as bar:
        count = make_questions(cfg.folders, cfg.out, jobs=cfg.jobs, overwrite=cfg.overwrite, on_scenes=bar.update)
    print_line(f"wrote {format_count(count, 'question')} to {cfg.out / 'questions.jsonl'}")
    return 0


@resumable
def render(cfg: Render) -> int:
    from robocas_ms3.cli.progress import ProgressBar
    from robocas_ms3.cli.terminal import print_line
    from robocas_ms3.core.checks import check_number
    from robocas_ms3.evaluation.removal_questions.question_files import read_question_set, render_questions

    check_number("--jobs", cfg.jobs, 1)
    questions = read_question_set(cfg.questions)
    with ProgressBar("images rendered") as bar:
        render_questions(questions, cfg.out, jobs=cfg.jobs, overwrite=cfg.overwrite, on_images=bar.update)
    print_line(f"wrote {format_count(len(questions.questions), 'question')} to {cfg.out / 'questions.jsonl'}")
    return 0


def convert(cfg: Convert) -> int:
    from robocas_ms3.cli.terminal import print_line
    from robocas_ms3.evaluation.removal_questions.lerobot_dataset import write_lerobot
    from robocas_ms3.evaluation.removal_questions.question_files import read_question_set

    questions = read_question_set(cfg.questions)
    write_lerobot(questions, cfg.out, overwrite=cfg.overwrite)
    print_line(f"wrote {format_count(len(questions.questions), 'episode')} to {cfg.out}")
    return 0


def answer(cfg: Answer) -> int:
    from robocas_ms3.cli.eval_results import read
    from robocas_ms3.cli.terminal import print_line
    from robocas_ms3.core.json_lines import JsonLinesFile
    from robocas_ms3.evaluation.removal_questions import records
    from robocas_ms3.evaluation.removal_questions.question_files import read_question_set
    from robocas_ms3.evaluation.removal_questions.scores import make_answers

    questions = read_question_set(cfg.questions).questions
    answers = make_answers(questions, read(cfg.folders).outcomes.values())
    JsonLinesFile[records.Answer](cfg.out, records.Answer).rewrite(answers)
    without = sum(one.answer is None for one in answers)
    print_line(f"wrote {format_count(len(answers), 'answer')} to {cfg.out}, {without} of them null")
    return 0


def score(cfg: Score) -> int:
    from robocas_ms3.cli.terminal import print_line, print_table
    from robocas_ms3.evaluation.removal_questions.question_files import read_question_set
    from robocas_ms3.evaluation.removal_questions.scores import (
        compute_chance,
        read_answers,
        score_answers,
        score_rules,
    )

    questions = read_question_set(cfg.questions).questions
    scores = [score_answers(path.stem, questions, read_answers(path)) for path in cfg.answers]
    scores += score_rules(questions)
    removals = sorted({question.removals for question in questions})
    counts = [sum(question.removals == number for question in questions) for number in removals]
    headers = ("answers", f"right of {len(questions)} (95 % interval)")
    headers += tuple(
        f"{format_count(number, 'removal')} (n = {count})" for number, count in zip(removals, counts, strict=True)
    )
    rows = [
        (
            one.name,
            f"{one.accuracy.rate:.1%} ({one.accuracy.low:.1%} to {one.accuracy.high:.1%})",
            *(f"{one.by_removals[number].rate:.1%}" for number in removals),
        )
        for one in scores
    ]
    by_chance = [
        compute_chance([question for question in questions if question.removals == number]) for number in removals
    ]
    rows.append(
        ("random object", f"{compute_chance(questions):.1%} (expected)", *(f"{rate:.1%}" for rate in by_chance))
    )
    print_table(headers, rows)
    print_line("highest object, scripted policy: they know the state of the simulator")
    return 0


COMMANDS = {"make": make, "render": render, "convert": convert, "answer": answer, "score": score}
