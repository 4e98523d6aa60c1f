"""Draw the numbers of objects into an image."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
from numpy.typing import NDArray

_RADIUS = 14  # pixels
_TEXT_COLOUR, _EDGE_COLOUR = (255, 255, 255), (255, 255, 255)
_FILL_COLOUR = (20, 20, 20)
_FONT, _FONT_SCALE, _THICKNESS = cv2.FONT_HERSHEY_SIMPLEX, 0.6, 2


def draw_numbers(image: NDArray[np.uint8], masks: Mapping[int, NDArray[np.bool_]]) -> NDArray[np.uint8]:
    """Return the image with each number in a circle, at the pixel of `find_inner_pixel`.

    Args:
        image: (H, W, 3) RGB.
        masks: (H, W) visible pixels of an object, by its number.
    """
    marked = image.copy()
    for number, mask in masks.items():
        row, column = find_inner_pixel(mask)
        center = (
            min(max(column, _RADIUS), image.shape[1] - _RADIUS - 1),
            min(max(row, _RADIUS), image.shape[0] - _RADIUS - 1),
        )
        cv2.circle(marked, center, _RADIUS, _FILL_COLOUR, cv2.FILLED, cv2.LINE_AA)
        cv2.circle(marked, center, _RADIUS, _EDGE_COLOUR, 1, cv2.LINE_AA)
        text = str(number)
        (width, height), _ = cv2.getTextSize(text, _FONT, _FONT_SCALE, _THICKNESS)
        start = (center[0] - width // 2, center[1] + height // 2)
        cv2.putText(marked, text, start, _FONT, _FONT_SCALE, _TEXT_COLOUR, _THICKNESS, cv2.LINE_AA)
    return marked


def find_inner_pixel(mask: NDArray[np.bool_]) -> tuple[int, int]:
    """Return row and column of the true pixel of a mask (H, W) that is farthest from false pixels and the border."""
    padded = np.pad(mask, 1).astype(np.uint8)
    distances = cv2.distanceTransform(padded, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
    row, column = np.unravel_index(distances.argmax(), distances.shape)
    return int(row), int(column)
