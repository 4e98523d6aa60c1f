import pytest
from plan_stages import run_here


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory):
    """The made-up plan as one job on this machine makes it, to compare with; nobody may change it."""
    out = tmp_path_factory.mktemp("plan") / "out"
    run_here(out)
    return out
