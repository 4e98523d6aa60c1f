"""Fixture for tests of terms and rewards."""

from __future__ import annotations

import pytest
import torch


@pytest.fixture(params=["torch", "numpy"])
def make_array(request):
    """Return a function that converts lists to a native array: a tensor (GPU) or NumPy (CPU)."""

    def convert(values):
        tensor = torch.as_tensor(values)
        return tensor if request.param == "torch" else tensor.numpy()

    return convert
