"""Which images a dataset holds, and how they are encoded; boxes of objects in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.text import one_line
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.images.image_headers import LARGEST, read_image_bytes
from robocas_ms3.datasets.images.png import encode_png
from robocas_ms3.datasets.sources.files import SEE_VALIDATE
from robocas_ms3.robots.cameras import STANDARD_CAMERA_NAMES

_QUALITY = {
    "jpg": [cv2.IMWRITE_JPEG_QUALITY, 95],
    "webp": [cv2.IMWRITE_WEBP_QUALITY, 90],
}

SMALLEST = 16
"""Pixels per side of an image that shows something."""
Box = tuple[int, int, int, int]
"""x_min, y_min, x_max, y_max: first and last column and row of the pixels, from 0 at the top left."""


@dataclass(frozen=True)
class ImageOptions:
    """What is rendered and stored; no cameras: all that there are, no size: the cameras' own.

    The standard cameras come first, in their order. ``boxes``: the box of the target is determined in each image.
    """

    cameras: tuple[str, ...] = ()
    size: tuple[int, int] | None = None
    depth: bool = True
    image_format: schema.ImageFormat = "png"
    boxes: bool = False

    def __post_init__(self) -> None:
        if self.size is not None and not SMALLEST <= min(self.size) <= max(self.size) <= LARGEST:
            expected = f"{SMALLEST} to {LARGEST} pixels a side"
            raise DatasetError("no such size of images", where="size", expected=expected, found=list(self.size))
        names = [*STANDARD_CAMERA_NAMES, *self.cameras]
        object.__setattr__(self, "cameras", tuple(name for name in dict.fromkeys(names) if name in self.cameras))

    def choose(self, cameras: Sequence[str], where: object) -> ImageOptions:
        """Return the same of those cameras that there are, in their order; ``where`` they are, for messages."""
        wrong = sorted(set(self.cameras) - set(cameras))
        if wrong:
            raise DatasetError("no such camera", where=where, expected=f"some of {', '.join(cameras)}", found=wrong)
        return replace(self, cameras=tuple(name for name in cameras if name in (self.cameras or cameras)))

    @property
    def kinds(self) -> tuple[str, ...]:
        return schema.IMAGE_KINDS if self.depth else ("rgb",)


def write_image(path: Path, image: NDArray) -> None:
    """Encode (H, W, 3) RGB or (H, W) depth by the file's suffix."""
    try:
        data = encode_png(image) if path.suffix == ".png" else _encode(image, path.suffix)
    except (ValueError, cv2.error) as error:
        raise DatasetError("can't encode this image", where=path, found=one_line(error)) from error
    path.write_bytes(data)  # unlike cv2.imwrite this says when the disk is full


def _encode(image: NDArray[np.uint8], suffix: str) -> bytes:
    encoded, data = cv2.imencode(suffix, cv2.cvtColor(image, cv2.COLOR_RGB2BGR), _QUALITY[suffix[1:]])
    if not encoded:
        raise ValueError(f"{image.dtype} {image.shape}")
    return data.tobytes()


def read_image(path: Path) -> NDArray:
    """Decode an image: (H, W, 3) RGB uint8 or (H, W) uint16."""
    try:
        data = np.frombuffer(read_image_bytes(path), np.uint8)
    except (OSError, ValueError) as error:
        found = getattr(error, "strerror", None) or error
        raise DatasetError("can't read this image", where=path, found=found, fix=SEE_VALIDATE) from error
    image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    if image is None:
        raise DatasetError("this image is damaged", where=path, fix=SEE_VALIDATE)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB) if image.ndim == 3 else image


def bounding_box(mask: NDArray[np.bool_]) -> Box | None:
    """Return the box around the pixels of a mask (H, W), or None where there are none."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return None
    return int(columns[0]), int(rows[0]), int(columns[-1]), int(rows[-1])
