"""A question about the order of removals, and an answer to it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from robocas_ms3.datasets.images.image_files import Box

Number = Annotated[int, Field(ge=1)]
Episode = Annotated[int, Field(ge=0, le=10**7)]
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
    """Question which object has to be removed first in the scene of an episode.

    Attributes:
        episode: number of the episode in its protocol.
        image: path of the image with the numbers, relative to the folder of the questions.
        instruction: instruction of the robot.
        question: text of the question.
        objects: numbered objects in the order of their numbers, 1 to N; not the target and hardly visible objects.
        answers: all correct numbers, in ascending order.
        removals: smallest number of removals after which the target can be grasped.
        target_box: bounding box of the visible pixels of the target; None: not visible.
        highest: number of the object with the highest point.
        scripted: number of the object that the scripted policy moves first; None: it has no number, or is unknown.

    Raises:
        ValueError: the values are inconsistent.
    """

    episode: Episode
    image: str
    instruction: Text
    question: Text
    objects: list[NumberedObject]
    answers: list[Number]
    removals: Number
    target_box: Box | None
    highest: Number
    scripted: Number | None

    def __post_init__(self) -> None:
        numbers = [numbered.number for numbered in self.objects]
        if numbers != list(range(1, len(numbers) + 1)):
            raise ValueError(f"objects: expected the numbers 1 to {len(numbers)} in order, found {numbers}")
        if len({numbered.slot for numbered in self.objects}) < len(numbers):
            raise ValueError("objects: expected different slots")
        correct = set(self.answers)
        if not correct or not correct < set(numbers) or sorted(correct) != self.answers:
            raise ValueError(f"answers: expected some of the numbers 1 to {len(numbers)}, found {self.answers}")
        for name, number in (("highest", self.highest), ("scripted", self.scripted)):
            if number is not None and number not in numbers:
                raise ValueError(f"{name}: expected a number from 1 to {len(numbers)}, found {number}")
        if self.image != name_image(self.episode):
            raise ValueError(f"image: expected {name_image(self.episode)}, found {self.image!r}")


@dataclass(frozen=True)
class Answer:
    """Answer to a question.

    Attributes:
        episode: episode of the question.
        answer: number of an object; None: no answer. Both no answer and a number that is not in the image count as
            wrong.
    """

    episode: Episode
    answer: Number | None


def name_image(episode: int) -> str:
    """Return the path of the image of a question, relative to the folder of the questions."""
    return f"images/{episode:06d}.png"


def make_question_text(instruction: str, target: str) -> str:
    """Return the text of a question."""
    return (
        f"A robot with a parallel gripper has this task: {instruction.rstrip('.')}. It lifts objects and puts them "
        f"aside, or pushes them away, one at a time, until it can grasp the {target}. Which numbered object should it "
        "remove first, so that it has to remove as few objects as possible? Answer with the number of the object."
    )
