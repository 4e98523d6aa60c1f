"""Encoding of messages: msgpack, with arrays in the format of openpi-client.

Received bytes are not trusted.
"""

from __future__ import annotations

import math
import re
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import WireError
from robocas_ms3.core.text import one_line

MAX_BYTES = 64 * 2**20  # per message
MAX_DEPTH = 16  # levels of nested maps and lists
MAX_ITEMS = 100_000  # in all maps and lists of a message; an array counts as one item
_MAX_LIST, _MAX_MAP, _MAX_DIMENSIONS, _MAX_LENGTH = 10_000, 1_000, 8, 2**31
_DTYPE = re.compile(r"[<>|=]?(b1|[iu][1248]|f[248])")  # np.dtype accepts more types, such as pickled objects
_ARRAY, _SCALAR = b"__ndarray__", b"__npgeneric__"


def encode_message(value: Any) -> bytes:
    """Return the msgpack bytes of a value made of maps, lists, texts, bytes, numbers, None and numeric NumPy arrays.

    Raises:
        WireError: the value contains another type.
    """
    try:
        return msgpack.Packer(default=_encode_array).pack(value)
    except (TypeError, ValueError, OverflowError) as error:
        expected = "maps, lists, texts, bytes, numbers, None and numeric arrays"
        raise WireError("cannot encode the message", expected=expected, found=error) from error


def decode_message(data: bytes, max_bytes: int = MAX_BYTES) -> Any:
    """Decode the msgpack bytes of a message.

    Arrays are writable copies in native byte order. NumPy scalars become Python numbers.

    Raises:
        WireError: the message is invalid, or exceeds a limit.
    """
    if len(data) > max_bytes:
        raise WireError("message too large", expected=f"at most {max_bytes} bytes", found=f"{len(data)} bytes")
    items = 0

    def count_items(container: Any) -> Any:
        """Count the items of a decoded map or list and return it, so that a small message cannot fill the memory."""
        nonlocal items
        items += 1 + len(container)
        if items > MAX_ITEMS:
            raise ValueError(f"too many items: expected at most {MAX_ITEMS}, found at least {items}")
        return container

    try:
        value = msgpack.unpackb(
            data,
            object_hook=count_items,
            list_hook=count_items,
            max_array_len=_MAX_LIST,
            max_map_len=_MAX_MAP,
            max_ext_len=0,
        )
    except (ValueError, OverflowError, RecursionError, msgpack.UnpackException) as error:
        raise WireError("invalid message", found=one_line(error, 200)) from error
    return _decode_value(value, 0)


def _encode_array(value: Any) -> dict[bytes, Any]:
    if not isinstance(value, np.ndarray | np.generic):
        raise TypeError(f"a value of type {type(value).__name__}")
    if not _DTYPE.fullmatch(value.dtype.str):
        raise TypeError(f"an array of {value.dtype}")
    if isinstance(value, np.generic):
        return {_SCALAR: True, b"data": value.item(), b"dtype": value.dtype.str}
    return {_ARRAY: True, b"data": value.tobytes(), b"dtype": value.dtype.str, b"shape": value.shape}


def _decode_value(value: Any, depth: int) -> Any:
    if depth > MAX_DEPTH:
        raise WireError("too many levels of maps and lists in a message", expected=f"at most {MAX_DEPTH}")
    if isinstance(value, list):
        return [_decode_value(one, depth + 1) for one in value]
    if not isinstance(value, dict):
        if isinstance(value, msgpack.ExtType):
            raise WireError("invalid message", found=one_line(value, 200))
        return value
    if _ARRAY in value:
        return _decode_array(value)
    if _SCALAR in value:
        return _decode_scalar(value)
    if not all(isinstance(key, str) for key in value):
        raise WireError("invalid keys of a map", expected="texts", found=one_line(list(value), 200))
    return {key: _decode_value(one, depth + 1) for key, one in value.items()}


def _decode_array(value: dict[Any, Any]) -> NDArray[Any]:
    data, shape, dtype = value.get(b"data"), value.get(b"shape"), _parse_dtype(value.get(b"dtype"))
    if (
        len(value) != 4
        or not isinstance(data, bytes)
        or not isinstance(shape, list)
        or len(shape) > _MAX_DIMENSIONS
        or not all(type(length) is int and 0 <= length < _MAX_LENGTH for length in shape)
        or len(data) != math.prod(shape) * dtype.itemsize
    ):
        found = f"{type(data).__name__} of {len(data) if isinstance(data, bytes) else '?'} bytes, shape {shape}"
        raise WireError("invalid array", expected="data whose size fits dtype and shape", found=one_line(found, 200))
    # Received bytes may have any value; NumPy requires 0 or 1 for bool.
    stored = np.dtype(np.uint8) if dtype.kind == "b" else dtype
    try:
        return np.ndarray(shape, stored, buffer=data).astype(dtype.newbyteorder("="))
    except ValueError as error:  # an empty array with lengths beyond NumPy's limit
        raise WireError("invalid array", found=one_line(error, 200)) from error


def _decode_scalar(value: dict[Any, Any]) -> bool | int | float:
    number = value.get(b"data")
    if len(value) != 3 or not isinstance(number, bool | int | float):
        raise WireError("invalid scalar", expected="data and dtype of a number", found=one_line(value, 200))
    _parse_dtype(value.get(b"dtype"))
    return number


def _parse_dtype(text: Any) -> np.dtype:
    if isinstance(text, str) and _DTYPE.fullmatch(text):
        return np.dtype(text)
    raise WireError(
        "invalid dtype", expected="bool, integers or floats, such as <f4 or |u1", found=one_line(repr(text), 200)
    )
