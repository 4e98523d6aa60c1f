"""Rotations of batches, which are tensors or NumPy arrays (`core.arrays`). Quaternions are wxyz.

Quaternion products are computed in float64 and returned in float32, since float32 matrix products may use TF32 on a
GPU. Rotation matrices are computed in float32. ManiSkill's own functions give the same values, but take 0.3 ms each on
a CPU. `core.poses` has rigid transforms in float64.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from robocas_ms3.core.arrays import Array, as_float32, as_float64, concatenate, matmul, where


def from_euler(angles: Array) -> Array:
    """Convert intrinsic XYZ Euler angles (N, 3) in rad to unit quaternions (N, 4), w >= 0: R = Rx Ry Rz."""
    half = 0.5 * as_float64(angles)
    library: Any = torch if isinstance(half, Tensor) else np
    (cx, cy, cz), (sx, sy, sz) = library.cos(half).T, library.sin(half).T
    yz = cy * cz, sy * sz, sy * cz, cy * sz
    parts = [
        cx * yz[0] - sx * yz[1],
        sx * yz[0] + cx * yz[1],
        cx * yz[2] - sx * yz[3],
        cx * yz[3] + sx * yz[2],
    ]
    return standardize(as_float32(library.stack(parts, 1)))


def multiply(first: Array, second: Array) -> Array:
    """Multiply unit quaternions (N, 4); return products (N, 4) with w >= 0."""
    product = matmul(left_product_matrix(as_float64(first)), as_float64(second)[:, :, None])
    return standardize(as_float32(product[:, :, 0]))


def rotate_float64(quaternion: Array, vector: Array) -> Array:
    """Rotate vectors (N, 3) by unit quaternions (N, 4); compute in float64, return float32."""
    left = left_product_matrix(as_float64(quaternion))
    half = matmul(left[:, :, 1:], as_float64(vector)[:, :, None])
    return as_float32(matmul(left, concatenate([-half[:, :1], half[:, 1:]], axis=1))[:, 1:, 0])


def standardize(quaternion: Array) -> Array:
    """Flip the signs of quaternions (N, 4) so that w >= 0."""
    return where(quaternion[:, :1] < 0, -quaternion, quaternion)


def left_product_matrix(quaternion: Array) -> Array:
    """Return the matrices L(q) (N, 4, 4) of quaternions q (N, 4), so that q * p = L(q) p for every quaternion p."""
    if isinstance(quaternion, Tensor):
        return torch.stack(_left_product_elements(*quaternion.T), 1).reshape(-1, 4, 4)
    return (quaternion @ _LEFT).reshape(-1, 4, 4)


def _left_product_elements(w: Any, x: Any, y: Any, z: Any) -> list[Any]:
    return [w, -x, -y, -z, x, w, -z, y, y, z, w, -x, z, -y, x, w]


_LEFT = np.array([_left_product_elements(*unit) for unit in np.eye(4)])

# Coefficients of the rotation matrix (row-major) for the products ww, wx, wy, ..., zz of the quaternion's components
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
def _product_table_on(device: torch.device) -> Tensor:
    return torch.from_numpy(_PRODUCTS).to(device)


def to_matrix(quaternion: Array) -> Array:
    """Convert unit quaternions (..., 4) to rotation matrices (..., 3, 3)."""
    # few array operations, since the overhead per operation dominates
    products = quaternion[..., :, None] * quaternion[..., None, :]
    table = _product_table_on(quaternion.device) if isinstance(quaternion, Tensor) else _PRODUCTS
    shape = quaternion.shape[:-1]
    return (products.reshape(*shape, 16) @ table).reshape(*shape, 3, 3)


def rotate_inverse(quaternion: Array, vector: Array) -> Array:
    """Rotate vectors (..., 3) by the inverse of unit quaternions (..., 4)."""
    return (vector[..., None, :] @ to_matrix(quaternion))[..., 0, :]


def rotate(quaternion: Array, vector: Array) -> Array:
    """Rotate vectors (..., 3) by unit quaternions (..., 4)."""
    return (to_matrix(quaternion) @ vector[..., None])[..., 0]


def vertical_axis(quaternion: Array) -> Array:
    """Return the z axes (..., 3) of frames with orientations (..., 4), unit quaternions."""
    return to_matrix(quaternion)[..., 2]
