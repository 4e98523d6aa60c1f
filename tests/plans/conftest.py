import pytest
from plan_stages import PLAN, stages

from robocas_ms3.plans.engines.local import LocalEngine
from robocas_ms3.plans.run import run_plan


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory):
    """The made-up plan as this machine makes it in one slot, to compare with; nobody may change it."""
    out = tmp_path_factory.mktemp("plan") / "out"
    run_plan(PLAN, out, lambda plan, out: LocalEngine(plan, out, 1, stages=stages()), jobs=1)
    return out
