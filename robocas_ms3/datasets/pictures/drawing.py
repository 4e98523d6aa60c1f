"""Draws an episode's pictures with what is told of it: frames of a video, rows of a contact sheet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

Pictures = Mapping[str, NDArray[np.uint8]]
"""Camera -> (H, W, 3) RGB, of one step."""
Size = tuple[int, int]
"""Width and height, pixels."""

COLUMNS = 8
"""Pictures in a row of a contact sheet."""
THUMBNAIL = (213, 160)
"""Of these."""
_BAND = 64  # height of the text below the pictures
_LEFT, _CAPTION, _GAP, _BELOW = 110, 30, 3, 10  # of a row
_INK, _FAINT, _PAPER = (245, 245, 245), (170, 180, 190), (24, 26, 30)


@dataclass(frozen=True)
class Story:
    """What an episode tells beside its pictures; known before they are rendered.

    Attributes:
        number: of the episode.
        instruction: the whole episode's.
        goal_types, goals: of the sub-goal at each of T steps.
        gripper_open: (T,) command.
    """

    number: int
    instruction: str
    goal_types: Sequence[str]
    goals: Sequence[str]
    gripper_open: NDArray[np.bool_]

    @classmethod
    def of(cls, number: int, arrays: Mapping[str, NDArray]) -> Story:
        """Of an episode's arrays, by the schema's keys."""
        types, texts = arrays["step_goal_type"].tolist(), arrays["step_lang_goals"].tolist()
        return cls(number, str(arrays["language_goal"]), types, texts, arrays["gripper_status"])

    @property
    def steps(self) -> int:
        """T."""
        return len(self.goals)


def draw_frame(story: Story, step: int, pictures: Pictures, panel: Size) -> NDArray[np.uint8]:
    """One picture of a video, (H, W, 3) RGB: the cameras side by side, each as large as a panel; texts below."""
    width, height = panel
    canvas = Image.new("RGB", (width * len(pictures), height + _BAND), _PAPER)
    draw = ImageDraw.Draw(canvas)
    for index, (camera, picture) in enumerate(pictures.items()):
        canvas.paste(_fit(picture, panel), (index * width, 0))
        _label(draw, (index * width + 6, 5), camera.replace("_", " "), 14)
    state = "open" if story.gripper_open[step] else "closed"
    clock = f"episode {story.number}   step {step} / {story.steps - 1}   gripper {state}"
    _text(draw, (10, height + 7), story.instruction, 20, _INK, canvas.width - 20)
    clock_width = round(draw.textlength(clock, _font(16)))
    goal = f"{story.goal_types[step]}: {story.goals[step]}"
    _text(draw, (10, height + 37), goal, 16, _FAINT, canvas.width - clock_width - 40)
    draw.text((canvas.width - clock_width - 10, height + 37), clock, _FAINT, _font(16))
    return np.asarray(canvas)


def row_steps(steps: int) -> list[int]:
    """Return the steps that a row shows: evenly spaced, from the first to the last."""
    return np.linspace(0, steps - 1, COLUMNS).round().astype(int).tolist()


def draw_row(story: Story, shown: Mapping[int, Pictures], rate_hz: float) -> NDArray[np.uint8]:
    """Return a contact sheet's part of one episode, (H, W, 3) RGB: a row per camera, below the instruction.

    Args:
        story: of the episode.
        shown: pictures of at least the steps of `row_steps`.
        rate_hz: steps a second.
    """
    width, height = THUMBNAIL
    steps = row_steps(story.steps)
    cameras = list(shown[0])
    size = _LEFT + COLUMNS * (width + _GAP), _CAPTION + len(cameras) * (height + _GAP) + _BELOW
    row = Image.new("RGB", size, _PAPER)
    draw = ImageDraw.Draw(row)
    _text(draw, (8, 6), f"{story.number}   {story.instruction}", 18, _INK, row.width - 16)
    for index, camera in enumerate(cameras):
        y = _CAPTION + index * (height + _GAP)
        for line, word in enumerate(camera.split("_")):
            draw.text((8, y + 6 + 20 * line), word, _FAINT, _font(16))
        for column, step in enumerate(steps):
            x = _LEFT + column * (width + _GAP)
            row.paste(_fit(shown[step][camera], THUMBNAIL), (x, y))
            if index == 0:
                _label(draw, (x + 5, y + 4), f"{step / rate_hz:.1f} s", 13)
            if index == len(cameras) - 1:
                _label(draw, (x + 5, y + height - 22), str(story.goal_types[step]), 13)
    return np.asarray(row)


def _fit(picture: NDArray[np.uint8], size: Size) -> Image.Image:
    smaller = picture.shape[1] > size[0]
    how = cv2.INTER_AREA if smaller else cv2.INTER_NEAREST_EXACT
    return Image.fromarray(cv2.resize(picture, size, interpolation=how))


@lru_cache
def _font(size: int) -> Any:
    return ImageFont.load_default(size)  # Pillow's own scalable font: no file needed


def _text(draw: ImageDraw.ImageDraw, at: tuple[int, int], text: str, size: int, ink, width: int) -> None:
    """Write one line, smaller where it is too long."""
    while size > 10 and draw.textlength(text, _font(size)) > width:
        size -= 1
    draw.text(at, text, ink, _font(size))


def _label(draw: ImageDraw.ImageDraw, at: tuple[int, int], text: str, size: int) -> None:
    """Write on a picture: light with a dark rim."""
    draw.text(at, text, _INK, _font(size), stroke_width=2, stroke_fill=(0, 0, 0))
