"""Images of the page: depth in colours, thumbnails, JPEG encoding."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets.images.video import colour_depth
from robocas_ms3.datasets.sources.files import SEE_VALIDATE

THUMBNAIL = (96, 72)
"""Width and height in pixels: twice the shown size, for high-resolution screens."""
_QUALITY = 85


@dataclass(frozen=True)
class EncodedImage:
    """Content of an image file, and its media type."""

    media_type: str
    data: bytes


def check_inside(path: Path, root: Path) -> Path:
    """Return a path unchanged; raise DatasetError if it is a link to a file outside the dataset ``root``."""
    if not path.resolve().is_relative_to(root.resolve()):
        raise DatasetError(
            "this link points to a file outside the dataset", where=path, fix="Copy the file into the dataset."
        )
    return path


def render_depth(depth: NDArray[np.uint16], width: int | None = None) -> EncodedImage:
    """Return a depth image (H, W) in mm as colours on a log scale: near is red, far is blue.

    Args:
        depth: depth in mm; 0: no depth.
        width: maximum width of the result in pixels; None: the width of the image.
    """
    return encode_jpeg(_shrink(colour_depth(depth), width))


def shrink_image(image: EncodedImage, width: int) -> EncodedImage:
    return encode_jpeg(_shrink(decode_image(image), width))


def shrink_to_thumbnail(image: EncodedImage) -> EncodedImage:
    small = cv2.resize(decode_image(image, cv2.IMREAD_REDUCED_COLOR_4), THUMBNAIL, interpolation=cv2.INTER_AREA)
    return encode_jpeg(np.asarray(small, np.uint8))


def decode_image(image: EncodedImage, flags: int = cv2.IMREAD_COLOR) -> NDArray[np.uint8]:
    pixels = cv2.imdecode(np.frombuffer(image.data, np.uint8), flags) if image.data else None
    if pixels is None:
        raise DatasetError("damaged image", fix=SEE_VALIDATE)
    return np.asarray(pixels[..., ::-1], np.uint8)


def encode_jpeg(image: NDArray[np.uint8]) -> EncodedImage:
    _, data = cv2.imencode(".jpg", np.ascontiguousarray(image[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    return EncodedImage("image/jpeg", data.tobytes())


def _shrink(image: NDArray[np.uint8], width: int | None) -> NDArray[np.uint8]:
    height, now = image.shape[:2]
    if width is None or now <= width:
        return image
    size = (width, max(1, round(height * width / now)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
