"""Draw the numbers of objects into an image."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
from numpy.typing import NDArray

_RADIUS = 11  # pixels
_FILL_COLOUR, _TEXT_COLOUR = (20, 20, 20), (255, 255, 255)
_FONT, _FONT_SCALE, _THICKNESS = cv2.FONT_HERSHEY_SIMPLEX, 0.5, 1


def draw_numbers(image: NDArray[np.uint8], masks: Mapping[int, NDArray[np.bool_]]) -> NDArray[np.uint8]:
    """Return the image with each number in a circle on its object.

    The circle of a number is at the pixel of its mask that is farthest from the edge of the mask, and from the circles
    of objects with fewer visible pixels.

    Args:
        image: (H, W, 3) RGB.
        masks: (H, W) visible pixels of an object, by its number.
    """
    marked, free = image.copy(), np.ones(image.shape[:2], np.uint8)
    for number, mask in sorted(masks.items(), key=lambda item: np.count_nonzero(item[1])):
        allowed = mask & (free > 0)
        row, column = find_inner_pixel(allowed if allowed.any() else mask)
        cv2.circle(free, (column, row), 2 * _RADIUS + 2, 0, cv2.FILLED)
        cv2.circle(marked, (column, row), _RADIUS, _FILL_COLOUR, cv2.FILLED, cv2.LINE_AA)
        cv2.circle(marked, (column, row), _RADIUS, _TEXT_COLOUR, 1, cv2.LINE_AA)
        (width, height), _ = cv2.getTextSize(str(number), _FONT, _FONT_SCALE, _THICKNESS)
        start = (column - width // 2, row + height // 2)
        cv2.putText(marked, str(number), start, _FONT, _FONT_SCALE, _TEXT_COLOUR, _THICKNESS, cv2.LINE_AA)
    return marked


def find_inner_pixel(mask: NDArray[np.bool_]) -> tuple[int, int]:
    """Return row and column of the true pixel of a mask (H, W) that is farthest from false pixels and the border."""
    padded = np.pad(mask, 1).astype(np.uint8)
    distances = cv2.distanceTransform(padded, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
    row, column = np.unravel_index(distances.argmax(), distances.shape)
    return int(row), int(column)
