"""Rotations of batches, tensors or NumPy's arrays (`arrays`). Quaternions are wxyz.

`core.poses` has rigid transforms in float64. Products of quaternions are as those of ManiSkill, whose own functions
take a third of a millisecond on a CPU: float32, computed in float64, as products of float32 matrices may be TF32 on a
GPU. Matrices of quaternions are computed in float32.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from robocas_ms3.core.arrays import Array, as_double, as_float, choose, join, matmul


def from_euler(angles: Array) -> Array:
    """Return unit quaternions (N, 4), w >= 0, of intrinsic XYZ Euler angles (N, 3), rad: R = Rx Ry Rz."""
    half = 0.5 * as_double(angles)
    library: Any = torch if isinstance(half, Tensor) else np
    (cx, cy, cz), (sx, sy, sz) = library.cos(half).T, library.sin(half).T
    yz = cy * cz, sy * sz, sy * cz, cy * sz
    parts = [
        cx * yz[0] - sx * yz[1],
        sx * yz[0] + cx * yz[1],
        cx * yz[2] - sx * yz[3],
        cx * yz[3] + sx * yz[2],
    ]
    return positive(as_float(library.stack(parts, 1)))


def multiply(first: Array, second: Array) -> Array:
    """Return products (N, 4), w >= 0, of unit quaternions (N, 4)."""
    product = matmul(left_matrix(as_double(first)), as_double(second)[:, :, None])
    return positive(as_float(product[:, :, 0]))


def turn(quaternion: Array, vector: Array) -> Array:
    """Return vectors (N, 3) turned by unit quaternions (N, 4)."""
    left = left_matrix(as_double(quaternion))
    half = matmul(left[:, :, 1:], as_double(vector)[:, :, None])
    return as_float(matmul(left, join([-half[:, :1], half[:, 1:]], axis=1))[:, 1:, 0])


def positive(quaternion: Array) -> Array:
    """Return the same rotations as quaternions (N, 4) with w >= 0."""
    return choose(quaternion[:, :1] < 0, -quaternion, quaternion)


def left_matrix(quaternion: Array) -> Array:
    """Return the matrices (N, 4, 4) that multiply quaternions by others (N, 4) from the left."""
    if isinstance(quaternion, Tensor):
        return torch.stack(_left_numbers(*quaternion.T), 1).reshape(-1, 4, 4)
    return (quaternion @ _LEFT).reshape(-1, 4, 4)


def _left_numbers(w: Any, x: Any, y: Any, z: Any) -> list[Any]:
    return [w, -x, -y, -z, x, w, -z, y, y, z, w, -x, z, -y, x, w]


_LEFT = np.array([_left_numbers(*unit) for unit in np.eye(4)])

# The entries of a rotation matrix, row by row, in the products of a quaternion's numbers, ww, wx, wy, ..., zz.
_PRODUCTS = np.array(
    [
        # ww wx wy wz  xw xx xy xz  yw yx yy yz  zw zx zy zz
        [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, -1, 0, 0, 0, 0, -1],
        [0, 0, 0, -2, 0, 0, 2, 0, 0, 0, 0, 0, 0, 0, 0, 0],
        [0, 0, 2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 0, 0, 0, 0],
        [0, 0, 0, 2, 0, 0, 2, 0, 0, 0, 0, 0, 0, 0, 0, 0],
        [1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, -1],
        [0, -2, 0, 0, 0, 0, 0, 0, 0, 0, 0, 2, 0, 0, 0, 0],
        [0, 0, -2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 0, 0, 0, 0],
        [0, 2, 0, 0, 0, 0, 0, 0, 0, 0, 0, 2, 0, 0, 0, 0],
        [1, 0, 0, 0, 0, -1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1],
    ],
    np.float32,
).T


@cache
def _products_on(device: torch.device) -> Tensor:
    return torch.from_numpy(_PRODUCTS).to(device)


def rotation(quaternion: Array) -> Array:
    """Return the matrices (..., 3, 3) of unit quaternions (..., 4)."""
    # few operations, as each takes longer than its arithmetic
    products = quaternion[..., :, None] * quaternion[..., None, :]
    table = _products_on(quaternion.device) if isinstance(quaternion, Tensor) else _PRODUCTS
    shape = quaternion.shape[:-1]
    return (products.reshape(*shape, 16) @ table).reshape(*shape, 3, 3)


def rotate_inverse(quaternion: Array, vector: Array) -> Array:
    """Rotate vectors (..., 3) by the inverse of unit quaternions (..., 4)."""
    return (vector[..., None, :] @ rotation(quaternion))[..., 0, :]


def rotate(quaternion: Array, vector: Array) -> Array:
    """Rotate vectors (..., 3) by unit quaternions (..., 4)."""
    return (rotation(quaternion) @ vector[..., None])[..., 0]


def upward(quaternion: Array) -> Array:
    """Return the vertical axes (..., 3) of bodies with unit quaternions (..., 4)."""
    return rotation(quaternion)[..., 2]
