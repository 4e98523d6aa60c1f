"""Questions for tests, and a folder of questions with images that no renderer made."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np

from robocas_ms3.datasets.images.image_files import write_image
from robocas_ms3.evaluation.removal_questions.records import NumberedObject, RemovalQuestion

SCENES = {"heap": {"task": "search", "config": "search_table_stacked"}}


def make_question(seed: int, answers: list[int], *, objects: int = 4, removals: int = 1, **rules: int | None):
    numbered = [
        NumberedObject(number, number, f"object_{number}", f"object {number}", (0, 0, 9, 9))
        for number in range(1, objects + 1)
    ]
    rules = {"highest": 1, "scripted": None, **rules}
    name = f"heap-{seed}"
    text = f"search the thing {seed % 2}"
    return RemovalQuestion(
        name, f"images/{name}.png", text, f"{text}?", numbered, answers, removals, seed=seed, **rules
    )  # pyright: ignore[reportCallIssue]


def write_folder(folder: Path, questions: list[RemovalQuestion], *, images: bool = True) -> Path:
    (folder / "images").mkdir(parents=True)
    (folder / "questions.json").write_text(json.dumps({"scenes": SCENES}))
    lines = [json.dumps(asdict(question)) for question in questions]
    (folder / "questions.jsonl").write_text("\n".join(lines) + "\n")
    for number, question in enumerate(questions if images else []):
        write_image(folder / question.image, np.full((24, 32, 3), 10 * number, np.uint8))
    return folder
