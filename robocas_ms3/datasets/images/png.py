"""PNG encoder with libdeflate: four times as fast as OpenCV at level 1, smaller files, deterministic.

The deflate of ISA-L is faster, but not deterministic: about once in some thousand images its bytes differ.
"""

from __future__ import annotations

import struct

import deflate
import numpy as np
from numpy.typing import NDArray

SIGNATURE = b"\x89PNG\r\n\x1a\n"
_GREY, _RGB = 0, 2
_SUB = 1  # row filter: difference to the pixel on the left, which is mostly zero in rendered images
_LEVEL = 1  # 1 to 12; level 2 takes 60 % longer and saves 4 %


def encode_png(image: NDArray) -> bytes:
    """Encode an image, (H, W, 3) uint8 RGB, (H, W) uint8 or (H, W) uint16, as PNG."""
    known = ((np.uint8, (3,)), (np.uint8, ()), (np.uint16, ()))
    if not image.size or (image.dtype, image.shape[2:]) not in known:
        raise ValueError(f"{image.dtype} {image.shape}")
    height, width = image.shape[:2]
    bits, colour = 8 * image.itemsize, _RGB if image.ndim == 3 else _GREY
    if bits == 16:
        image = image.astype(">u2")  # PNG is big endian
    pixels = np.ascontiguousarray(image).view(np.uint8).reshape(height, -1)
    step = pixels.shape[1] // width
    rows = np.empty((height, 1 + pixels.shape[1]), np.uint8)
    rows[:, 0] = _SUB
    rows[:, 1 : 1 + step] = pixels[:, :step]
    np.subtract(pixels[:, step:], pixels[:, :-step], out=rows[:, 1 + step :])
    header = struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, 0)
    data = deflate.zlib_compress(rows, _LEVEL)
    return b"".join([SIGNATURE, *_make_chunk(b"IHDR", header), *_make_chunk(b"IDAT", data), *_make_chunk(b"IEND", b"")])


def _make_chunk(kind: bytes, content: bytes | bytearray) -> tuple[bytes, bytes, bytes | bytearray, bytes]:
    checksum = deflate.crc32(content, deflate.crc32(kind))
    return struct.pack(">I", len(content)), kind, content, struct.pack(">I", checksum)
