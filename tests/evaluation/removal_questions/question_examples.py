"""Questions for tests, and a folder of questions with images that no renderer made."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from robocas_ms3.datasets.images.image_files import write_image
from robocas_ms3.evaluation.removal_questions.records import NumberedObject, RemovalQuestion, name_image


def make_question(episode: int, answers: list[int], *, objects: int = 4, **values: Any) -> RemovalQuestion:
    """Make a question with objects in a row; the boxes of higher numbers are smaller."""
    numbered = [
        NumberedObject(
            number,
            10 + number,
            f"object_{number}",
            f"object {number}",
            (100 * number, 0, 100 * number + 50 - number, 9),
        )
        for number in range(1, objects + 1)
    ]
    text = f"search the thing {episode % 2}"
    given = {"removals": 1, "target_box": None, "highest": 1, "scripted": None, **values}
    return RemovalQuestion(episode, name_image(episode), text, f"{text}?", numbered, answers, **given)


def write_folder(folder: Path, questions: list[RemovalQuestion], *, images: bool = True) -> Path:
    (folder / "images").mkdir(parents=True)
    (folder / "questions.json").write_text(json.dumps({"questions_hash": "00", "protocol_hash": "ab"}))
    lines = [json.dumps(asdict(question)) for question in questions]
    (folder / "questions.jsonl").write_text("".join(f"{line}\n" for line in lines))
    for number, question in enumerate(questions if images else []):
        write_image(folder / question.image, np.full((24, 32, 3), 10 * number, np.uint8))
    return folder
