"""Values as bytes: msgpack, with arrays as openpi-client writes them. What is read is not trusted."""

from __future__ import annotations

import math
import re
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import WireError

MAX_BYTES = 64 * 2**20  # of a message
MAX_DEPTH = 16  # of maps and lists in each other
MAX_ITEMS = 100_000  # of all maps and lists together; arrays count as one
_MAX_LIST, _MAX_MAP, _MAX_DIMENSIONS, _MAX_LENGTH = 10_000, 1_000, 8, 2**31
_DTYPE = re.compile(r"[<>|=]?[biuf][1248]")  # np.dtype understands much more, pickled objects among it
_ARRAY, _SCALAR = b"__ndarray__", b"__npgeneric__"


def pack(value: Any) -> bytes:
    """Bytes of a value made of maps, lists, texts, bytes, numbers, None and NumPy arrays of numbers.

    Raises:
        WireError: something else is in it.
    """
    try:
        return msgpack.Packer(default=_written).pack(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise WireError("can't be sent", found=error) from error


def unpack(data: bytes, max_bytes: int = MAX_BYTES) -> Any:
    """The value of bytes. Arrays are copies, writable, in this machine's byte order; NumPy scalars are Python's.

    Raises:
        WireError: they are no message, or one beyond the limits.
    """
    if len(data) > max_bytes:
        raise WireError("a message is too large", expected=f"{max_bytes} bytes at most", found=len(data))
    try:
        value = msgpack.unpackb(
            data,
            object_hook=(count := _Counter()),
            list_hook=count,
            ext_hook=_refuse_extension,
            max_array_len=_MAX_LIST,
            max_map_len=_MAX_MAP,
            max_ext_len=0,
        )
    except (ValueError, OverflowError, RecursionError, msgpack.UnpackException) as error:
        raise WireError("no message", found=_line(error)) from error
    return _read(value, 0)


class _Counter:
    """Counts what is in maps and lists as they are read, so that a small message can't fill the memory."""

    def __init__(self) -> None:
        self.items = 0

    def __call__(self, container: Any) -> Any:
        self.items += 1 + len(container)
        if self.items > MAX_ITEMS:
            raise ValueError(f"more than {MAX_ITEMS} items")
        return container


def _refuse_extension(code: int, data: bytes) -> Any:
    raise ValueError(f"extension type {code}")


def _written(value: Any) -> dict[bytes, Any]:
    if not isinstance(value, np.ndarray | np.generic):
        raise TypeError(f"a {type(value).__name__}")
    if not _DTYPE.fullmatch(value.dtype.str):
        raise TypeError(f"an array of {value.dtype}")
    if isinstance(value, np.generic):
        return {_SCALAR: True, b"data": value.item(), b"dtype": value.dtype.str}
    return {_ARRAY: True, b"data": value.tobytes(), b"dtype": value.dtype.str, b"shape": value.shape}


def _read(value: Any, depth: int) -> Any:
    if depth > MAX_DEPTH:
        raise WireError("a message is too deep", expected=f"{MAX_DEPTH} levels at most")
    if isinstance(value, list):
        return [_read(one, depth + 1) for one in value]
    if not isinstance(value, dict):
        return value
    if _ARRAY in value:
        return _array(value)
    if _SCALAR in value:
        return _scalar(value)
    for key in value:
        if not isinstance(key, str):
            raise WireError("a key is no text", found=_line(repr(key)))
    return {key: _read(one, depth + 1) for key, one in value.items()}


def _array(value: dict[Any, Any]) -> NDArray[Any]:
    if value.keys() != {_ARRAY, b"data", b"dtype", b"shape"}:
        raise WireError("no array", expected="data, dtype and shape", found=_line(sorted(map(str, value))))
    data, shape, dtype = value[b"data"], value[b"shape"], _dtype(value[b"dtype"])
    if not isinstance(shape, list) or len(shape) > _MAX_DIMENSIONS:
        raise WireError("no shape of an array", expected=f"{_MAX_DIMENSIONS} lengths at most", found=_line(shape))
    if not all(type(length) is int and 0 <= length < _MAX_LENGTH for length in shape):
        raise WireError("no shape of an array", found=_line(shape))
    size = math.prod(shape) * dtype.itemsize
    if not isinstance(data, bytes) or len(data) != size:
        found = f"{len(data)} bytes" if isinstance(data, bytes) else type(data).__name__
        raise WireError("an array's data don't fit its shape", expected=f"{size} bytes", found=found)
    stored = np.dtype(np.uint8) if dtype.kind == "b" else dtype  # a bool's byte may be any, and NumPy expects 0 or 1
    try:
        return np.ndarray(shape, stored, buffer=data).astype(dtype.newbyteorder("="))
    except ValueError as error:  # empty, and as long as no array may be
        raise WireError("no shape of an array", found=_line(error)) from error


def _scalar(value: dict[Any, Any]) -> bool | int | float:
    number = value.get(b"data")
    if value.keys() != {_SCALAR, b"data", b"dtype"} or not isinstance(number, bool | int | float):
        raise WireError("no scalar", expected="data and dtype of a number", found=_line(value))
    _dtype(value[b"dtype"])
    return number


def _dtype(text: Any) -> np.dtype:
    try:
        if isinstance(text, str) and _DTYPE.fullmatch(text):
            return np.dtype(text)
    except TypeError:  # such as f1
        pass
    raise WireError("no type of numbers", expected="such as <f4 or |u1", found=_line(repr(text)))


def _line(text: object) -> str:
    return " ".join(str(text).split())[:200]
