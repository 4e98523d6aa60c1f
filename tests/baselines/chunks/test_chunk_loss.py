"""What chunks are trained by, by hand."""

from types import SimpleNamespace

import pytest
import torch

from robocas_ms3.baselines.chunks.loss import chunk_losses
from robocas_ms3.baselines.chunks.poses import Scale

ONE = Scale([0.0] * 9, [1.0] * 9)


def losses(near):
    """Of two samples with one step: the first reaches 0.1 m, and is off by 0.3 m; the second 0.3 m, and is right."""
    weights = SimpleNamespace(near=near, gripper_weight=0.5, keys_weight=2.0)
    model = SimpleNamespace(config=weights, chunk_scale=ONE, key_scale=ONE)
    chunk, key = torch.zeros(2, 1, 10), torch.zeros(2, 9)
    chunk[0, 0, 0], chunk[1, 0, 0], key[:, 1] = 0.1, 0.3, 0.04
    found = chunk.clone()
    found[0, 0, 0] += 0.3
    return chunk_losses(model, {"chunk": chunk, "key": key}, found, key + 0.003)


def test_by_hand():
    found = losses(near=0.0)
    assert found["motion"].item() == pytest.approx(0.3 / 9 / 2)
    assert found["gripper"].item() == pytest.approx(0.693147)  # even odds
    assert found["keys"].item() == pytest.approx(0.003)
    assert found["loss"].item() == pytest.approx(0.3 / 18 + 0.5 * 0.693147 + 2 * 0.003)
    assert found["first_mm"].item() == found["last_mm"].item() == pytest.approx(150)
    assert found["near_mm"].tolist() == [2 * found["key_mm"].item(), 2.0]  # of both
    assert found["key_mm"].item() == pytest.approx(3 * 3**0.5)


def test_what_is_near_counts_more():
    """With 0.1 m, weights are 1/2 and 1/4."""
    assert losses(near=0.1)["motion"].item() == pytest.approx(0.3 / 9 * 2 / 3)
