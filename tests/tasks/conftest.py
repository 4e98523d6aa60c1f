"""What tests of terms and rewards share."""

from __future__ import annotations

import pytest
import torch


@pytest.fixture(params=["torch", "numpy"])
def make(request):
    """Arrays of both kinds that terms take, as they lie on a GPU and on a CPU: float32, or bool, or int64."""

    def as_kind(values):
        tensor = torch.as_tensor(values)
        return tensor if request.param == "torch" else tensor.numpy()

    return as_kind
