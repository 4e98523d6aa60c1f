"""A question about the order of removals, and an answer to it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from robocas_ms3.core.checks import MAX_SEED
from robocas_ms3.datasets.images.image_files import Box

Number = Annotated[int, Field(ge=1)]
Text = Annotated[str, Field(min_length=1)]


@dataclass(frozen=True)
class NumberedObject:
    """Object with a number in the image of a question.

    Attributes:
        number: number in the image, from 1 on.
        slot: object slot in the scene.
        asset: id of the object in its pack.
        name: name of the object.
        box: bounding box of its visible pixels.
    """

    number: Number
    slot: Annotated[int, Field(ge=0)]
    asset: Text
    name: Text
    box: Box


@dataclass(frozen=True)
class RemovalQuestion:
    """Question which object has to be removed first.

    Attributes:
        id: name of the scenes and seed, such as ``search_table_stacked-290001``.
        image: path of the image with the numbers, relative to the folder of the questions.
        instruction: instruction of the robot.
        question: text of the question.
        objects: numbered objects; the target and objects that are hardly visible have no number.
        answers: all numbers that are right.
        removals: smallest number of removals after which the target can be grasped.
        highest: number of the object with the highest point.
        scripted: number of the object that the scripted policy moves first; None: it has no number.
        seed: seed of the scene.
    """

    id: Text
    image: Text
    instruction: Text
    question: Text
    objects: list[NumberedObject]
    answers: Annotated[list[Number], Field(min_length=1)]
    removals: Number
    highest: Number
    scripted: Number | None
    seed: Annotated[int, Field(ge=0, le=MAX_SEED)]


@dataclass(frozen=True)
class Answer:
    """Answer to a question.

    Attributes:
        id: id of the question.
        answer: number of an object; None: no answer, which is wrong.
    """

    id: Text
    answer: int | None


def make_question_text(instruction: str, target: str) -> str:
    """Return the text of a question."""
    return (
        f"A robot with a parallel gripper has this task: {instruction.rstrip('.')}. It removes one object at a time "
        f"until it can grasp the {target}. Which numbered object should it remove first, so that it has to remove as "
        "few objects as possible? Answer with the number of the object."
    )
