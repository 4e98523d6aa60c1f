"""Fixture for tests of terms and rewards."""

from __future__ import annotations

import pytest
import torch


@pytest.fixture(params=["torch", "numpy"])
def make(request):
    """Return a function that makes native arrays of a GPU or a CPU (float32, bool or int64)."""

    def as_kind(values):
        tensor = torch.as_tensor(values)
        return tensor if request.param == "torch" else tensor.numpy()

    return as_kind
