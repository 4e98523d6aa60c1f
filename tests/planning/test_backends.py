"""Planners by name."""

import pytest

from robocas_ms3.core.errors import ExtensionError
from robocas_ms3.planning.backends import BACKENDS, DEFAULT, make_planner
from robocas_ms3.planning.protocol import Planner
from robocas_ms3.robots.table import PANDA


@pytest.mark.parametrize("name", BACKENDS)
def test_every_backend_is_a_planner_with_the_step_it_was_given(name):
    planner = make_planner(name, PANDA, dt=0.1)
    assert all(hasattr(planner, member) for member in vars(Planner) if not member.startswith("_"))
    assert planner.plan_to_qpos([0, -1, 0, -2.5, 0, 1.4, 0.8], [[0.2, -1, 0, -2.5, 0, 1.4, 0.8]], stage="x").dt == 0.1


def test_an_unknown_name_is_refused():
    assert DEFAULT in BACKENDS
    for name in ("ompl", "mplib"):
        with pytest.raises(ExtensionError) as caught:
            make_planner(name, PANDA, dt=0.1)
        assert "'rrt_connect'" in caught.value.expected
        assert caught.value.found == repr(name)
