"""Planners by name."""

import pytest

from robocas_ms3.errors import RobocasError
from robocas_ms3.planning.backends import BACKENDS, DEFAULT, make_planner
from robocas_ms3.planning.protocol import Planner


@pytest.mark.parametrize("name", BACKENDS)
def test_every_backend_is_a_planner_with_the_step_it_was_given(name, panda_files):
    planner = make_planner(name, panda_files.arm_urdf, panda_files.arm_srdf, dt=0.1)
    assert all(hasattr(planner, member) for member in vars(Planner) if not member.startswith("_"))
    assert planner.plan_to_qpos([0, -1, 0, -2.5, 0, 1.4, 0.8], [[0.2, -1, 0, -2.5, 0, 1.4, 0.8]], stage="x").dt == 0.1


def test_an_unknown_name_is_refused(panda_files):
    assert DEFAULT in BACKENDS
    with pytest.raises(RobocasError, match="no such planner.*mplib.*ompl"):
        make_planner("ompl", panda_files.arm_urdf, panda_files.arm_srdf, dt=0.1)
