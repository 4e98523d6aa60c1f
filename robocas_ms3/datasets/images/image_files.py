"""Image options of a dataset, encoding and decoding of images, and bounding boxes in them."""

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
"""Smallest width and height of an image in pixels."""
Box = tuple[int, int, int, int]
"""x_min, y_min, x_max, y_max: first and last column and row in pixels, from 0 at the top left."""


def check_image_size(size: tuple[int, int], where: str = "size") -> None:
    """Raise DatasetError unless width and height are between `SMALLEST` and `LARGEST` pixels."""
    if not SMALLEST <= min(size) <= max(size) <= LARGEST:
        expected = f"{SMALLEST} to {LARGEST} pixels"
        raise DatasetError("invalid image size", where=where, expected=expected, found=list(size))


@dataclass(frozen=True)
class ImageOptions:
    """Options of the images that are rendered and stored.

    Attributes:
        cameras: names of the cameras, standard cameras first; empty: all cameras.
        size: width and height in pixels; None: the size in the task configuration.
        depth: whether there are depth images in addition to RGB.
        image_format: format of RGB images.
        boxes: whether the bounding box of the target in each image is computed.
        segmentation: whether there are segmentation images (`StepImages`).
    """

    cameras: tuple[str, ...] = ()
    size: tuple[int, int] | None = None
    depth: bool = True
    image_format: schema.ImageFormat = "png"
    boxes: bool = False
    segmentation: bool = False

    def __post_init__(self) -> None:
        if self.size is not None:
            check_image_size(self.size)
        names = [*STANDARD_CAMERA_NAMES, *self.cameras]
        object.__setattr__(self, "cameras", tuple(name for name in dict.fromkeys(names) if name in self.cameras))

    def select_cameras(self, available: Sequence[str], where: object) -> ImageOptions:
        """Return the options with the requested cameras (default: all), in the order of ``available``."""
        unknown = sorted(set(self.cameras) - set(available))
        if unknown:
            expected, found = f"some of {', '.join(available)}", ", ".join(unknown)
            raise DatasetError("no such camera", where=where, expected=expected, found=found, usage=True)
        return replace(self, cameras=tuple(name for name in available if name in (self.cameras or available)))

    @property
    def kinds(self) -> tuple[str, ...]:
        return schema.IMAGE_KINDS if self.depth else ("rgb",)


def write_image(path: Path, image: NDArray) -> None:
    """Write an image, (H, W, 3) uint8 RGB or (H, W) uint16 depth, in the format of the suffix."""
    try:
        data = encode_png(image) if path.suffix == ".png" else _encode(image, path.suffix)
    except (ValueError, cv2.error) as error:
        expected = "(H, W, 3) uint8 or (H, W) uint16"
        raise DatasetError("can't encode this image", where=path, expected=expected, found=one_line(error)) from error
    path.write_bytes(data)  # unlike cv2.imwrite, raises an error if the disk is full


def _encode(image: NDArray[np.uint8], suffix: str) -> bytes:
    encoded, data = cv2.imencode(suffix, cv2.cvtColor(image, cv2.COLOR_RGB2BGR), _QUALITY[suffix[1:]])
    if not encoded:
        raise ValueError(f"{image.dtype} {image.shape}")
    return data.tobytes()


def read_image(path: Path) -> NDArray:
    """Read an image: (H, W, 3) uint8 RGB or (H, W) uint16 depth."""
    try:
        data = np.frombuffer(read_image_bytes(path), np.uint8)
    except (OSError, ValueError) as error:
        found = getattr(error, "strerror", None) or error
        raise DatasetError("can't read this image", where=path, found=found, fix=SEE_VALIDATE) from error
    image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    if image is None:
        raise DatasetError("this image is damaged", where=path, fix=SEE_VALIDATE)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB) if image.ndim == 3 else image


def compute_bounding_box(mask: NDArray[np.bool_]) -> Box | None:
    """Return the bounding box of the true pixels of a mask (H, W); None if no pixel is true."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return None
    return int(columns[0]), int(rows[0]), int(columns[-1]), int(rows[-1])
