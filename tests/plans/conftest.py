import shutil

import pytest
from plan_stages import run_here


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory):
    """The made-up plan as one job on this machine makes it, to compare with; nobody may change it."""
    out = tmp_path_factory.mktemp("plan") / "out"
    run_here(out)
    return out


@pytest.fixture(scope="session")
def done(tmp_path_factory):
    out = tmp_path_factory.mktemp("done") / "out"
    with pytest.MonkeyPatch.context() as patch, pytest.raises(ZeroDivisionError):
        patch.setattr("robocas_ms3.plans.run.join", lambda *_, **__: 1 / 0)
        run_here(out)
    return out


@pytest.fixture
def out(done, tmp_path):
    """A folder of the plan, all of whose units are done and nothing is joined."""
    return shutil.copytree(done, tmp_path / "out")
