"""Random crops of images and their labels, for the training."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

_OBJECT_CROPS = 0.9  # fraction of crops near an object


def draw_crop(
    is_object: NDArray[np.bool_], size: tuple[int, int], scale: tuple[float, float], rng: np.random.Generator
) -> tuple[int, int, int, int]:
    """Draw a crop, mostly near an object; return left, top, width and height in pixels.

    is_object: (H, W) pixels of objects and handles.
    """
    height, width = is_object.shape
    factor = np.exp(rng.uniform(*np.log(scale)))
    crop_width, crop_height = min(width, int(size[0] * factor)), min(height, int(size[1] * factor))
    rows, columns = np.nonzero(is_object[::4, ::4])
    if len(rows) and rng.random() < _OBJECT_CROPS:
        index = rng.integers(len(rows))
        x = 4 * columns[index] + rng.integers(-crop_width // 3, crop_width // 3 + 1)
        y = 4 * rows[index] + rng.integers(-crop_height // 3, crop_height // 3 + 1)
    else:
        x, y = rng.integers(width), rng.integers(height)
    left = int(np.clip(x - crop_width // 2, 0, width - crop_width))
    top = int(np.clip(y - crop_height // 2, 0, height - crop_height))
    return left, top, crop_width, crop_height


def resize_inputs(image: NDArray[np.float32], size: tuple[int, int]) -> NDArray[np.float32]:
    """Scale an image (5, H, W) to a width and height; heights and depths are not interpolated."""
    colors = [cv2.resize(channel, size, interpolation=cv2.INTER_LINEAR) for channel in image[:3]]
    distances = [cv2.resize(channel, size, interpolation=cv2.INTER_NEAREST) for channel in image[3:]]
    return np.stack([*colors, *distances])


def augment_image(
    image: NDArray[np.float32],
    label: NDArray[np.uint8],
    vectors: list[NDArray[np.float32]],
    rng: np.random.Generator,
    *,
    upside_down: bool,
) -> tuple[NDArray[np.float32], NDArray[np.uint8], list[NDArray[np.float32]]]:
    """Change colours and distances randomly, and turn and reflect the image.

    Args:
        image: (5, H, W) inputs.
        label: (h, w) classes.
        vectors: offsets (3, h, w), and other vectors (3, 1, 1) in the camera frame.
        rng: random generator.
        upside_down: whether the image may be turned by half a turn, as images of the camera on the hand.
    """
    image = image.copy()
    shifts = rng.uniform(-0.15, 0.15) + rng.uniform(-0.06, 0.06, 3)
    image[:3] = image[:3] * np.float32(rng.uniform(0.75, 1.25)) + shifts.astype(np.float32)[:, None, None]
    image[3:] += rng.uniform((-0.15, -0.1), (0.15, 0.1)).astype(np.float32)[:, None, None]
    noise = np.array([0.02, 0.02, 0.02, 0.006, 0.006], np.float32)[:, None, None]
    image += noise * rng.standard_normal(image.shape, np.float32)
    if upside_down and rng.random() < 0.5:
        image, label = image[:, ::-1, ::-1], label[::-1, ::-1]
        vectors = [vector[:, ::-1, ::-1] * np.array([-1, -1, 1], np.float32)[:, None, None] for vector in vectors]
    if rng.random() < 0.5:
        image, label = image[:, :, ::-1], label[:, ::-1]
        vectors = [vector[:, :, ::-1] * np.array([-1, 1, 1], np.float32)[:, None, None] for vector in vectors]
    return image, label, vectors
