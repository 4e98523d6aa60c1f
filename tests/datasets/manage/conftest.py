import shutil

import pytest
from managing import as_upstream, make


@pytest.fixture(scope="module")
def four(tmp_path_factory):
    """Four episodes as RoboCAS-v0 writes them, that nobody may change."""
    return as_upstream(make(tmp_path_factory.mktemp("four"), "four", range(4)))


@pytest.fixture
def copy(four, tmp_path):
    return shutil.copytree(four, tmp_path / "four")
