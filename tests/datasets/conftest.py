import shutil

import pytest
from synthetic import RayCaster, stub_embeddings, write_trajectory

from robocas_ms3.datasets.conversion.convert import convert
from robocas_ms3.datasets.conversion.settings import ConversionSettings


@pytest.fixture(scope="session")
def trajectory(tmp_path_factory):
    return write_trajectory(tmp_path_factory.mktemp("trajectory") / "F.h5", seeds=(3, 4, 5), failed=(1,))


@pytest.fixture(scope="session")
def made(trajectory, tmp_path_factory):
    """A dataset of two episodes, for reading only."""
    out = tmp_path_factory.mktemp("made") / "dataset"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("robocas_ms3.datasets.conversion.convert.embed_texts", stub_embeddings)
        convert(ConversionSettings(trajectory, out, video=False, open_renderer=RayCaster))
    return out


@pytest.fixture
def dataset(made, tmp_path):
    """A copy that a test may change."""
    return shutil.copytree(made, tmp_path / "dataset")
