"""Reads a picture's header and checks that it is whole: a PNG by its checksums, without decoding it."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

from PIL import Image, UnidentifiedImageError

from robocas_ms3.datasets.pictures.png import SIGNATURE

_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}


@dataclass(frozen=True)
class PictureHeader:
    """Size in pixels, bits a channel, channels."""

    width: int
    height: int
    bits: int
    channels: int

    def __str__(self) -> str:
        return f"{self.width} x {self.height}, {self.channels} x {self.bits} bit"


def read_header(path: Path) -> PictureHeader:
    """Read a picture's header.

    Raises:
        ValueError: the file is of another format than its suffix says, cut off, or damaged.
    """
    return _read_png(path) if path.suffix == ".png" else _decode(path)


def _decode(path: Path) -> PictureHeader:
    wanted = {".jpg": "JPEG", ".webp": "WEBP"}[path.suffix]
    try:
        with Image.open(path, formats=[wanted]) as picture:
            picture.load()
            return PictureHeader(*picture.size, 8, len(picture.getbands()))
    except UnidentifiedImageError as error:
        raise ValueError(f"not a {wanted}") from error
    except OSError as error:
        raise ValueError(f"damaged {wanted}: {error}") from error


def _read_png(path: Path) -> PictureHeader:
    data = path.read_bytes()
    if not data.startswith(SIGNATURE):
        raise ValueError("not a PNG")
    offset, header, filled = len(SIGNATURE), None, False
    while offset + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, offset)
        end = offset + 8 + length
        if end + 4 > len(data):
            break
        if zlib.crc32(data[offset + 4 : end]) != struct.unpack_from(">I", data, end)[0]:
            raise ValueError("damaged PNG")
        if kind == b"IHDR":
            width, height, bits, colour = struct.unpack_from(">IIBB", data, offset + 8)
            header = PictureHeader(width, height, bits, _CHANNELS.get(colour, 0))
        filled = filled or (kind == b"IDAT" and length > 0)
        if kind == b"IEND" and header is not None:
            if not filled:
                raise ValueError("PNG without a picture")
            return header
        offset = end + 4
    raise ValueError("PNG cut off")
