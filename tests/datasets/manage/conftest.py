import shutil

import pytest
from managing import as_v0, make


@pytest.fixture(scope="module")
def four(tmp_path_factory):
    """Four episodes in the format of RoboCAS-v0, for reading only."""
    return as_v0(make(tmp_path_factory.mktemp("four"), "four", range(4)))


@pytest.fixture
def copy(four, tmp_path):
    return shutil.copytree(four, tmp_path / "four")
