"""Fixtures of the planning tests."""

from __future__ import annotations

import pytest
from planning_scenes import Checker

from robocas_ms3.planning.kinematics import ArmChain, InverseKinematics
from robocas_ms3.planning.rrt_connect import RRTConnectPlanner
from robocas_ms3.robots.description import MOBILE_PANDA
from robocas_ms3.robots.urdf import RobotFiles, make_robot_files


@pytest.fixture(scope="session")
def panda_files() -> RobotFiles:
    return make_robot_files()


@pytest.fixture(scope="session")
def checker(panda_files: RobotFiles) -> Checker:
    return Checker(panda_files.arm_urdf)


@pytest.fixture
def make_planner(panda_files: RobotFiles):
    def make(dt: float = 0.05) -> RRTConnectPlanner:
        return RRTConnectPlanner(panda_files.arm_urdf, panda_files.arm_srdf, robot=MOBILE_PANDA, dt=dt)

    return make


@pytest.fixture
def planner(make_planner) -> RRTConnectPlanner:
    return make_planner()


@pytest.fixture(scope="session")
def reachability(panda_files) -> InverseKinematics:
    return InverseKinematics(ArmChain(panda_files.arm_urdf, MOBILE_PANDA))
