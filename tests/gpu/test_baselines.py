"""Training and acting on a GPU; skipped without a CUDA device. `scripts/gpu_checks.sh` runs these tests."""

import devices
import pytest
import torch
from gpu_emulation import emulated_envs
from synthetic_dataset import synthetic_dataset

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device: unproven on a GPU"),
    pytest.mark.skipif(emulated_envs() > 0, reason="the emulation has no autograd"),
]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return synthetic_dataset(tmp_path_factory.mktemp("gpu"))


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
@pytest.mark.parametrize("name", devices.CHANGES)
def test_interrupted_training_continues_and_its_policy_acts(dataset, tmp_path, name, precision):
    devices.check(dataset, tmp_path, name, precision, "cuda")
