"""Training and acting on a GPU. Without a CUDA device all of it is skipped; `scripts/gpu_checks.sh` runs it."""

import devices
import pytest
import torch
from synthetic import RayCaster, made_up_vectors, write_trajectory

from robocas_ms3.datasets.writing.convert import convert

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device: unproven on a GPU"),
]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    made = tmp_path_factory.mktemp("gpu")
    trajectory = write_trajectory(made / "F.h5", seeds=range(3, 9))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("robocas_ms3.datasets.writing.convert.embed_texts", made_up_vectors)
        convert(trajectory, made / "dataset", open_source=RayCaster)
    return made / "dataset"


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
@pytest.mark.parametrize("name", devices.CHANGES)
def test_a_run_is_broken_off_goes_on_and_acts(dataset, tmp_path, name, precision):
    devices.check(dataset, tmp_path, name, precision, "cuda")
