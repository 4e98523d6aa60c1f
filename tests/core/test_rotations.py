"""Rotations of arrays and of tensors against ManiSkill's."""

from functools import partial

import numpy as np
import pytest
import torch
from mani_skill.utils.geometry.rotation_conversions import (
    euler_angles_to_matrix,
    matrix_to_quaternion,
    quaternion_apply,
    quaternion_multiply,
)

from robocas_ms3.core import rotations

same = partial(np.testing.assert_allclose, rtol=0, atol=2.5e-7)  # two units in the last place of 1


def batch(seed: int, columns: int, count: int = 3000) -> np.ndarray:
    """Numbers of many sizes, large, small and zero."""
    rng = np.random.default_rng(seed)
    values = rng.uniform(-1, 1, (count, columns)) * 10 ** rng.uniform(-4, 0.5, (count, 1))
    values[: count // 10] = 0
    return values.astype(np.float32)


def unit(values: np.ndarray) -> np.ndarray:
    lengths = np.linalg.norm(values, axis=1, keepdims=True)
    return np.where(lengths > 0, values / np.maximum(lengths, 1e-12), [1, 0, 0, 0]).astype(np.float32)


@pytest.mark.parametrize("scale", [1.0, 0.15])
def test_quaternions_from_euler_angles_match_maniskill(scale):
    angles = batch(0, 3) * np.float32(scale)
    expected = matrix_to_quaternion(euler_angles_to_matrix(torch.from_numpy(angles).double(), "XYZ"))
    expected = torch.where(expected[:, :1] < 0, -expected, expected)
    for found in (rotations.from_euler(angles), rotations.from_euler(torch.from_numpy(angles))):
        clear = expected[:, 0] > 1e-6  # at w = 0 either sign will do
        same(np.asarray(found)[clear], expected[clear])


def test_products_and_rotated_vectors_match_maniskill():
    first, second, vectors = unit(batch(1, 4)), unit(batch(2, 4)), batch(3, 3)
    tensors = [torch.from_numpy(array) for array in (first, second, vectors)]
    exact = [tensor.double() for tensor in tensors]
    products, turned = quaternion_multiply(*exact[:2]), quaternion_apply(exact[0], exact[2])
    for one, other, vector in ((first, second, vectors), tensors):
        same(rotations.multiply(one, other), products)
        same(rotations.rotate_float64(one, vector), turned)
