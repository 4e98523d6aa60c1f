"""Drawing of video frames and contact sheet rows from the images and texts of an episode."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

Images = Mapping[str, NDArray[np.uint8]]
"""Images (H, W, 3) RGB of one step, by camera."""
Size = tuple[int, int]
"""Width and height in pixels."""

COLUMNS = 8
"""Images in a row of a contact sheet."""
THUMBNAIL = (213, 160)
"""Width and height of an image on a contact sheet, pixels."""
_BAND = 64  # height of the text below the images
_LEFT, _CAPTION, _GAP, _BELOW = 110, 30, 3, 10  # of a row
_INK, _FAINT, _PAPER = (245, 245, 245), (170, 180, 190), (24, 26, 30)


class EpisodeDrawer:
    """Draws the images of an episode with its instruction, sub-goals and gripper state."""

    def __init__(self, number: int, arrays: Mapping[str, NDArray], rate_hz: float) -> None:
        self.number, self.rate_hz = number, rate_hz
        self._instruction, self._open = str(arrays["language_goal"]), arrays["gripper_status"]
        self._goals, self._types = arrays["step_lang_goals"].tolist(), arrays["step_goal_type"].tolist()
        self.row_steps: list[int] = np.linspace(0, len(self._goals) - 1, COLUMNS).round().astype(int).tolist()
        """Evenly spaced steps of the contact sheet, from the first to the last."""

    def draw_frame(self, step: int, images: Images, panel_size: Size) -> NDArray[np.uint8]:
        """Draw a video frame (H, W, 3) RGB: the images of all cameras next to each other, texts below.

        ``panel_size`` is the width and height of the image of one camera.
        """
        width, height = panel_size
        canvas = Image.new("RGB", (width * len(images), height + _BAND), _PAPER)
        draw = ImageDraw.Draw(canvas)
        for index, (camera, image) in enumerate(images.items()):
            canvas.paste(_resize_to(image, panel_size), (index * width, 0))
            _draw_label(draw, (index * width + 6, 5), camera.replace("_", " "), 14)
        state = "open" if self._open[step] else "closed"
        clock = f"episode {self.number}   step {step} / {len(self._goals) - 1}   gripper {state}"
        _draw_text(draw, (10, height + 7), self._instruction, 20, _INK, canvas.width - 20)
        clock_width = round(draw.textlength(clock, _load_font(16)))
        goal = f"{self._types[step]}: {self._goals[step]}"
        _draw_text(draw, (10, height + 37), goal, 16, _FAINT, canvas.width - clock_width - 40)
        draw.text((canvas.width - clock_width - 10, height + 37), clock, _FAINT, _load_font(16))
        return np.asarray(canvas)

    def draw_row(self, images_by_step: Mapping[int, Images]) -> NDArray[np.uint8]:
        """Draw the contact sheet row of the episode, (H, W, 3) RGB, from its images at the steps `row_steps`."""
        width, height = THUMBNAIL
        cameras = list(images_by_step[0])
        size = _LEFT + COLUMNS * (width + _GAP), _CAPTION + len(cameras) * (height + _GAP) + _BELOW
        row = Image.new("RGB", size, _PAPER)
        draw = ImageDraw.Draw(row)
        _draw_text(draw, (8, 6), f"{self.number}   {self._instruction}", 18, _INK, row.width - 16)
        for index, camera in enumerate(cameras):
            y = _CAPTION + index * (height + _GAP)
            for line, word in enumerate(camera.split("_")):
                draw.text((8, y + 6 + 20 * line), word, _FAINT, _load_font(16))
            for column, step in enumerate(self.row_steps):
                x = _LEFT + column * (width + _GAP)
                row.paste(_resize_to(images_by_step[step][camera], THUMBNAIL), (x, y))
                if index == 0:
                    _draw_label(draw, (x + 5, y + 4), f"{step / self.rate_hz:.1f} s", 13)
                if index == len(cameras) - 1:
                    _draw_label(draw, (x + 5, y + height - 22), str(self._types[step]), 13)
        return np.asarray(row)


def _resize_to(image: NDArray[np.uint8], size: Size) -> Image.Image:
    how = cv2.INTER_AREA if image.shape[1] > size[0] else cv2.INTER_NEAREST_EXACT
    return Image.fromarray(cv2.resize(image, size, interpolation=how))


@lru_cache
def _load_font(size: int) -> Any:
    return ImageFont.load_default(size)  # built into Pillow


def _draw_text(draw: ImageDraw.ImageDraw, position: tuple[int, int], text: str, size: int, ink, width: int) -> None:
    while size > 10 and draw.textlength(text, _load_font(size)) > width:
        size -= 1
    draw.text(position, text, ink, _load_font(size))


def _draw_label(draw: ImageDraw.ImageDraw, position: tuple[int, int], text: str, size: int) -> None:
    draw.text(position, text, _INK, _load_font(size), stroke_width=2, stroke_fill=(0, 0, 0))
