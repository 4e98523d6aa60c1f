"""Decode the binary data of a glTF file: buffers, buffer views and accessors."""

from __future__ import annotations

import base64
import binascii
from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from asset_tools.readers import gltf_schema as schema
from asset_tools.readers.files import LARGEST_FILE, ModelFiles
from robocas_ms3.core.errors import AssetError

Array = NDArray[np.float64]
Item = TypeVar("Item")

DTYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}


class BufferReader:
    """Reader of the binary data of a glTF file.

    Args:
        model: JSON of the file.
        blob: binary chunk of a GLB file, or empty.
        path: path of the file.
        files: files of the model, which reads referenced files.
    """

    def __init__(self, model: schema.Gltf, blob: bytes, path: Path, files: ModelFiles) -> None:
        self._model, self._blob, self._path, self._files = model, blob, path, files
        self._buffers: dict[int, bytes] = {}
        self._quantised = "KHR_mesh_quantization" in model.extensionsUsed

    def read_uri(self, uri: str) -> tuple[bytes, Path]:
        """Return the bytes of a URI, and the path of the file that contains them."""
        if uri.startswith("data:"):
            try:
                return base64.b64decode(unquote(uri.partition(",")[2]), validate=True), self._path
            except binascii.Error as error:
                raise ValueError(f"invalid data URI: {error}") from error
        file = self._files.find(unquote(uri), self._path.parent)
        if file is None:
            where, fix = self._path.parent / unquote(uri), "Put the file next to the mesh."
            raise AssetError("missing file of the mesh", where=where, fix=fix)
        return self._files.read(file), file

    def read_view(self, index: int) -> tuple[bytes, schema.BufferView]:
        """Return the bytes of the buffer view with an index, and the entry of the buffer view in the JSON."""
        view = get_entry(self._model.bufferViews, index, "bufferViews")
        if any("meshopt" in name for name in view.extensions):
            raise ValueError("the data is compressed (meshopt)")
        if view.buffer not in self._buffers:
            buffer = get_entry(self._model.buffers, view.buffer, "buffers")
            self._buffers[view.buffer] = self._blob if buffer.uri is None else self.read_uri(buffer.uri)[0]
            if sum(map(len, self._buffers.values())) > 2 * LARGEST_FILE:
                raise ValueError(f"the buffers have more than {2 * LARGEST_FILE >> 20} MB")
        data = self._buffers[view.buffer][view.byteOffset : view.byteOffset + view.byteLength]
        if len(data) < view.byteLength:
            raise ValueError(f"bufferViews.{index} needs {view.byteLength} bytes, but the buffer has only {len(data)}")
        return data, view

    def read_values(self, index: int) -> NDArray:
        """Return the values (count, width) of the accessor with an index.

        Integers that the file marks as normalised become floats in -1..1 or 0..1.
        """
        accessor = get_entry(self._model.accessors, index, "accessors")
        dtype, width = np.dtype(DTYPES[accessor.componentType]), WIDTHS[accessor.type]
        if accessor.bufferView is None:
            values = np.zeros((accessor.count, width), dtype)
        else:
            data, view = self.read_view(accessor.bufferView)
            values = _rows(data, accessor.byteOffset, view.byteStride, dtype, width, accessor.count)
        sparse = accessor.sparse
        if sparse is not None:
            at, kind = sparse.indices, np.dtype(DTYPES[sparse.indices.componentType])
            where = _rows(self.read_view(at.bufferView)[0], at.byteOffset, None, kind, 1, sparse.count)
            new_data, new_offset = self.read_view(sparse.values.bufferView)[0], sparse.values.byteOffset
            values = values.copy()
            values[where.reshape(-1).astype(np.int64)] = _rows(new_data, new_offset, None, dtype, width, sparse.count)
        return _normalised(values) if accessor.normalized else values

    def has_data(self, index: int) -> bool:
        """Return whether the accessor with an index has data; an accessor of compressed data may have none."""
        accessor = get_entry(self._model.accessors, index, "accessors")
        return accessor.bufferView is not None or accessor.sparse is not None

    def read_vectors(self, index: int, width: int) -> Array:
        """Return the vectors (V, width) of the accessor with an index as floats.

        Raises:
            ValueError: the vectors of the file have another width.
        """
        values = self.read_values(index)
        if values.shape[1] != width:
            raise ValueError(f"accessors.{index} has {values.shape[1]} components, expected {width}")
        return values.astype(float)

    def read_coordinates(self, index: int) -> Array:
        """Return the texture coordinates (V, 2), v downward, of the accessor with an index.

        Integers are divided by the largest value of their type, unless the file uses KHR_mesh_quantization.
        """
        values = self.read_values(index)
        if values.shape[1] != 2:
            raise ValueError(f"accessors.{index} has {values.shape[1]} components, expected 2")
        return (values if self._quantised else _normalised(values)).astype(float)

    def read_colors(self, index: int) -> Array:
        """Return the linear vertex colours (V, 3) in 0..1 of the accessor with an index; values may be NaN."""
        values = self.read_values(index)
        if values.shape[1] not in (3, 4):
            raise ValueError(f"accessors.{index} has {values.shape[1]} components, expected 3 or 4")
        return np.clip(_normalised(values)[:, :3].astype(float), 0, 1)


def get_entry(items: Sequence[Item], index: int | None, name: str) -> Item:
    """Return the entry with an index of a list in the file.

    Args:
        items: the list.
        index: index of the entry; None: the file gives no index.
        name: name of the list, for the error.

    Raises:
        ValueError: the entry does not exist.
    """
    if index is None or not 0 <= index < len(items):
        raise ValueError(f"{name} has no entry {index}; it has {len(items)} entries")
    return items[index]


def _normalised(values: NDArray) -> NDArray:
    """Divide integers by the largest value of their type; return floats unchanged."""
    if values.dtype.kind == "f":
        return values
    return np.maximum(values.astype(float) / np.iinfo(values.dtype).max, -1.0)


def _rows(data: bytes, offset: int, stride: int | None, dtype: np.dtype, width: int, count: int) -> NDArray:
    """Return ``count`` rows of ``width`` values (count, width) from bytes.

    Args:
        data: the bytes.
        offset: position of the first row, bytes.
        stride: distance between the starts of two rows, bytes; None: rows without gaps.
        dtype: type of a value.
        width: number of values per row.
        count: number of rows.
    """
    size = dtype.itemsize * width
    stride = stride or size
    if count and offset + stride * (count - 1) + size > len(data):
        raise ValueError(f"an accessor of {count} elements does not fit in {len(data)} bytes")
    return np.ndarray((count, width), dtype, data, offset, (stride, dtype.itemsize))
