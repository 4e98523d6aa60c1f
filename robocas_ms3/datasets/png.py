"""Reads a PNG's header and checks its checksums, without decoding it."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}


@dataclass(frozen=True)
class PngHeader:
    """Size in pixels, bits a channel, channels."""

    width: int
    height: int
    bits: int
    channels: int

    def __str__(self) -> str:
        return f"{self.width} x {self.height}, {self.channels} x {self.bits} bit"


def read_header(path: Path) -> PngHeader:
    """Read a PNG's header.

    Raises:
        ValueError: the file is no PNG, cut off, or damaged.
    """
    data = path.read_bytes()
    if not data.startswith(_SIGNATURE):
        raise ValueError("not a PNG")
    offset, header = len(_SIGNATURE), None
    while offset + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, offset)
        end = offset + 8 + length
        if end + 4 > len(data):
            break
        if zlib.crc32(data[offset + 4 : end]) != struct.unpack_from(">I", data, end)[0]:
            raise ValueError("damaged PNG")
        if kind == b"IHDR":
            width, height, bits, colour = struct.unpack_from(">IIBB", data, offset + 8)
            header = PngHeader(width, height, bits, _CHANNELS.get(colour, 0))
        if kind == b"IEND" and header is not None:
            return header
        offset = end + 4
    raise ValueError("PNG cut off")
