"""Rotations as ManiSkill computes them, on tensors or NumPy's arrays (`arrays`): the same numbers, rounded alike.

On a CPU, where batches have one row, ManiSkill's take a third of a millisecond. Quaternions are wxyz.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from mani_skill.utils.geometry.rotation_conversions import (
    euler_angles_to_matrix,
    matrix_to_quaternion,
    quaternion_apply,
    quaternion_multiply,
)
from numpy.typing import NDArray
from torch import Tensor

from robocas_ms3.arrays import Array

# columns of b that w, x, y and z of a are multiplied with in a product, and their signs
_COLUMNS = np.array([[0, 1, 2, 3], [1, 0, 3, 2], [2, 3, 0, 1], [3, 2, 1, 0]])
_SIGNS = np.array([[1, 1, 1, 1], [-1, 1, -1, 1], [-1, 1, 1, -1], [-1, -1, 1, 1]], np.float32)
_INVERSE = np.array([1, -1, -1, -1], np.float32)
_ZERO, _ONE, _TWO, _LEAST = np.float32(0), np.float32(1), np.float32(2), np.float32(0.1)


def from_euler(angles: Array) -> Array:
    """(N, 4) unit quaternions of intrinsic XYZ Euler angles (N, 3) float32, rad: R = Rx Ry Rz; w is not negative."""
    if isinstance(angles, Tensor):
        return matrix_to_quaternion(euler_angles_to_matrix(angles, "XYZ"))
    # NumPy's own functions round otherwise
    tensor = torch.from_numpy(angles)
    cosines, sines = torch.cos(tensor).numpy(), torch.sin(tensor).numpy()
    return np.stack([_from_cosines(*both) for both in zip(cosines, sines, strict=True)])


def _from_cosines(cosines: NDArray[np.float32], sines: NDArray[np.float32]) -> NDArray[np.float32]:
    (cx, cy, cz), (sx, sy, sz) = cosines, sines
    m10, m20 = sx * sy, -cx * sy
    m00, m01, m02 = cy * cz, -cy * sz, sy
    m10, m11, m12 = m10 * cz + cx * sz, cx * cz - m10 * sz, -sx * cy
    m20, m21, m22 = m20 * cz + sx * sz, sx * cz - m20 * sz, cx * cy
    # of each number of the quaternion, twice its size
    w = _ONE + m00 + m11 + m22
    x = _ONE + m00 - m11 - m22
    y = _ONE - m00 + m11 - m22
    z = _ONE - m00 - m11 + m22
    sizes = torch.sqrt(torch.from_numpy(np.maximum([w, x, y, z], _ZERO))).numpy()
    largest = int(sizes.argmax())
    size = sizes[largest]
    rows = (
        (size * size, m21 - m12, m02 - m20, m10 - m01),
        (m21 - m12, size * size, m10 + m01, m02 + m20),
        (m02 - m20, m10 + m01, size * size, m12 + m21),
        (m10 - m01, m20 + m02, m21 + m12, size * size),
    )
    quaternion = np.array(rows[largest], np.float32) / (_TWO * max(size, _LEAST))
    return -quaternion if quaternion[0] < 0 else quaternion


def multiply(first: Array, second: Array) -> Array:
    """(N, 4) products of unit quaternions (N, 4), float32, as those whose w is not negative."""
    if isinstance(first, Tensor):
        return quaternion_multiply(first, second)
    product = _product(first, second)
    return np.where(product[:, :1] < 0, -product, product)


def turn(quaternion: Array, vector: Array) -> Array:
    """(N, 3) vectors (N, 3) turned by unit quaternions (N, 4), float32."""
    if isinstance(quaternion, Tensor):
        return quaternion_apply(quaternion, vector)
    pure = np.zeros_like(quaternion)
    pure[:, 1:] = vector
    return _product(_product(quaternion, pure), quaternion * _INVERSE)[:, 1:]


def _product(first: NDArray[Any], second: NDArray[Any]) -> NDArray[Any]:
    parts = first[:, :, None] * (_SIGNS * second[:, _COLUMNS])
    return parts[:, 0] + parts[:, 1] + parts[:, 2] + parts[:, 3]
