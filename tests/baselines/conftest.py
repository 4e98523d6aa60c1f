"""A made-up baseline, and a small dataset for real ones."""

import pytest
from made_up_baseline import MadeUp
from synthetic import RayCaster, made_up_vectors, write_trajectory

from robocas_ms3.baselines.table import BASELINES
from robocas_ms3.datasets.writing.convert import convert


@pytest.fixture
def made_up(monkeypatch):
    monkeypatch.setitem(BASELINES.builtin, "made-up", MadeUp)
    return MadeUp


@pytest.fixture
def data(tmp_path):
    path = tmp_path / "data.h5"
    path.write_text("demonstrations")
    return path


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    """A dataset of six episodes of seven steps, 64 x 48 pictures, that nobody may change; five are to train on."""
    made = tmp_path_factory.mktemp("baselines")
    trajectory = write_trajectory(made / "F.h5", seeds=range(3, 9))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("robocas_ms3.datasets.writing.convert.embed_texts", made_up_vectors)
        convert(trajectory, made / "dataset", open_source=RayCaster)
    return made / "dataset"
