"""Pictures as the page wants them: depth in colours, and small ones for the table."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets.pictures.video import colour_depth

THUMBNAIL = (96, 72)
"""Width and height: twice what the table shows, for dense screens."""
_QUALITY = 85


@dataclass(frozen=True)
class Picture:
    """An encoded picture.

    Attributes:
        kind: media type, ``image/png``, ``image/jpeg`` or ``image/webp``.
        data: the file.
    """

    kind: str
    data: bytes


def inside(path: Path, root: Path) -> Path:
    """The path of a picture, unless it is a link that leads out of the dataset.

    Raises:
        DatasetError: it is.
    """
    if not path.resolve().is_relative_to(root.resolve()):
        raise DatasetError("this link leads out of the dataset", where=path)
    return path


def depth_picture(depth: NDArray[np.uint16], width: int | None = None) -> Picture:
    """Depth as colours on a logarithmic scale: near is red, far is blue, nothing is black."""
    return encode_jpeg(shrink(colour_depth(depth), width))


def shrunk(picture: Picture, width: int | None) -> Picture:
    """A picture as JPEG, at most this wide."""
    return encode_jpeg(shrink(decode(picture), width))


def thumbnail(picture: Picture) -> Picture:
    """A small JPEG."""
    small = cv2.resize(decode(picture, reduced=True), THUMBNAIL, interpolation=cv2.INTER_AREA)
    return encode_jpeg(np.asarray(small, np.uint8))


def shrink(picture: NDArray[np.uint8], width: int | None) -> NDArray[np.uint8]:
    """(H, W, 3), scaled down to a width where it is wider."""
    height, now = picture.shape[:2]
    if width is None or now <= width:
        return picture
    size = (width, max(1, round(height * width / now)))
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)


def decode(picture: Picture, *, reduced: bool = False) -> NDArray[np.uint8]:
    """(H, W, 3) RGB, or, faster, a quarter of that size.

    Raises:
        DatasetError: it is damaged.
    """
    flags = cv2.IMREAD_REDUCED_COLOR_4 if reduced else cv2.IMREAD_COLOR
    pixels = cv2.imdecode(np.frombuffer(picture.data, np.uint8), flags) if picture.data else None
    if pixels is None:
        raise DatasetError("this picture is damaged", fix="robocas validate lists all that is wrong.")
    return np.asarray(pixels[..., ::-1], np.uint8)


def encode_jpeg(picture: NDArray[np.uint8]) -> Picture:
    """(H, W, 3) RGB as JPEG."""
    bgr = np.ascontiguousarray(picture[..., ::-1])
    done, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    if not done:
        raise DatasetError("can't encode this picture", found=f"{picture.dtype} {picture.shape}")
    return Picture("image/jpeg", data.tobytes())
