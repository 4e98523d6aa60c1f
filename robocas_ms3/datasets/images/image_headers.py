"""Read image files and headers within size limits, and check that they are complete."""

from __future__ import annotations

import os
import struct
import zlib
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

from PIL import Image, UnidentifiedImageError

from robocas_ms3.core.documents import DocumentError, check_regular_file, read_bytes
from robocas_ms3.datasets.images.png import SIGNATURE

LARGEST = 8192
"""Largest width and height in pixels."""
BYTES_LIMIT = 2**28
"""Largest file in bytes; the largest image has 200 MB without compression."""
_END = 32  # bytes
_FORMATS = {".png": "PNG", ".jpg": "JPEG", ".webp": "WEBP"}
_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}


@dataclass(frozen=True)
class ImageHeader:
    """Header of an image: width and height in pixels, bits per channel, number of channels."""

    width: int
    height: int
    bits: int
    channels: int

    def __str__(self) -> str:
        return f"{self.width} x {self.height}, {self.channels} x {self.bits} bit"


def read_header(path: Path) -> ImageHeader:
    """Check a complete image file and return its header; raise ValueError or OSError if it is damaged."""
    data = read_image_bytes(path)
    return _check_png(data) if path.suffix == ".png" else _decode_header(data, _FORMATS[path.suffix])


def check_file_ends(path: Path) -> None:
    """Check the first and last bytes of an image file; raise ValueError or OSError if it is damaged.

    The whole file is read only if these bytes are not as expected.
    """
    if not _has_both_ends(path):
        read_header(path)


def _has_both_ends(path: Path) -> bool:
    check_regular_file(path)
    with path.open("rb", buffering=0) as file:
        head, size = file.read(_END), os.fstat(file.fileno()).st_size
        file.seek(max(0, size - _END))
        tail = file.read()
    if path.suffix == ".png":
        return head.startswith(SIGNATURE) and tail.endswith(b"\0\0\0\0IEND\xaeB`\x82")
    if path.suffix == ".jpg":
        return head.startswith(b"\xff\xd8\xff") and tail.endswith(b"\xff\xd9")
    return head.startswith(b"RIFF") and head[8:12] == b"WEBP" and size == 8 + int.from_bytes(head[4:8], "little")


def read_image_bytes(path: Path) -> bytes:
    """Return the bytes of an image file; raise DocumentError if it is damaged or larger than `LARGEST`."""
    data, image_format = read_bytes(path, BYTES_LIMIT), _FORMATS[path.suffix]
    try:
        with Image.open(BytesIO(data), formats=[image_format]) as image:
            size = image.size
    except Image.DecompressionBombError as error:
        raise DocumentError(str(error)) from error
    except (UnidentifiedImageError, SyntaxError) as error:  # SyntaxError: a damaged PNG
        raise DocumentError(f"not a {image_format}, or damaged") from error
    if max(size) > LARGEST:
        raise DocumentError(f"{size[0]} x {size[1]} pixels, more than {LARGEST} in width or height")
    return data


def _decode_header(data: bytes, image_format: str) -> ImageHeader:
    try:
        with Image.open(BytesIO(data), formats=[image_format]) as image:
            image.load()
            return ImageHeader(*image.size, 8, len(image.getbands()))
    except OSError as error:
        raise ValueError(f"damaged {image_format}: {error}") from error


def _check_png(data: bytes) -> ImageHeader:
    if not data.startswith(SIGNATURE):
        raise ValueError("not a PNG")
    offset, header, filled = len(SIGNATURE), None, False
    while offset + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, offset)
        end = offset + 8 + length
        if end + 4 > len(data):
            break
        if zlib.crc32(data[offset + 4 : end]) != struct.unpack_from(">I", data, end)[0]:
            raise ValueError("damaged PNG: wrong checksum")
        if kind == b"IHDR":
            width, height, bits, colour = struct.unpack_from(">IIBB", data, offset + 8)
            header = ImageHeader(width, height, bits, _CHANNELS.get(colour, 0))
        filled = filled or (kind == b"IDAT" and length > 0)
        if kind == b"IEND" and header is not None:
            if not filled:
                raise ValueError("PNG without image data (no IDAT chunk)")
            return header
        offset = end + 4
    raise ValueError("truncated PNG")
