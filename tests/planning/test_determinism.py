"""The same seed and calls give the same bits: repeated, in other processes, under load, after other calls."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from planning_scenes import REST, Box, cloud, table_scene, top_down

from robocas_ms3.core.errors import PlanningError

SCENE = [*table_scene(0), Box((0.55, 0.0, 0.15), (0.4, 0.03, 0.4))]


def session(planner) -> str:
    """Return a hash of the results of a sequence of calls, errors included."""
    digest, here = hashlib.sha256(), REST
    planner.attach(None)
    planner.set_scene(cloud(SCENE))
    for i in range(3):
        goal = top_down(0.5, 0.25 if i % 2 else -0.25, 0.2, yaw=0.4 * i)
        for qpos in planner.ik(goal, here):
            digest.update(qpos.tobytes())
        try:
            trajectory = planner.plan_to_pose(here, goal, stage="reach")
            here = trajectory.qpos[-1]
            digest.update(trajectory.qpos.tobytes())
            digest.update(planner.plan_straight(here, top_down(0.5, goal[1, 3], 0.25), stage="up").qpos.tobytes())
        except PlanningError as error:
            digest.update(str(error).encode())
    return digest.hexdigest()


def test_same_seed_in_one_process_gives_the_same_paths(make_planner):
    planner = make_planner()
    planner.seed(7)
    first = session(planner)
    planner.seed(9)
    assert session(planner) != first
    planner.set_scene(cloud([SCENE[-1]]))
    planner.plan_to_pose(REST, top_down(0.4, 0.3, 0.3), stage="x")
    planner.seed(7)
    assert session(planner) == first
    other = make_planner()
    other.plan_to_pose(REST, top_down(0.4, 0.3, 0.3), stage="x")
    np.random.seed(1)  # noqa: NPY002 - global state must not matter
    other.seed(7)
    assert session(other) == first


# With real-time scheduling, busy processes would block the machine, so they switch to normal scheduling.
BUSY = """
import os
if hasattr(os, "sched_setscheduler"):
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
while True:
    pass
"""
CHILD = """
import sys
sys.path.insert(0, sys.argv[1])
from test_determinism import session
from robocas_ms3.planning.rrt_connect import RRTConnectPlanner
from robocas_ms3.robots.description import MOBILE_PANDA
planner = RRTConnectPlanner(sys.argv[2], sys.argv[3], robot=MOBILE_PANDA, dt=0.05)
planner.seed(7)
print(session(planner))
"""


@pytest.mark.slow
def test_another_process_under_load_gives_the_same_paths(make_planner, panda_files):
    planner = make_planner()
    planner.seed(7)
    here = session(planner)
    command = [sys.executable, "-c", CHILD, str(Path(__file__).parent), panda_files.arm_urdf, panda_files.arm_srdf]
    busy = [subprocess.Popen([sys.executable, "-c", BUSY]) for _ in range(os.cpu_count() or 1)]
    try:
        # The number of threads must not matter either.
        environment = {**os.environ, "OMP_NUM_THREADS": "2"}
        run = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    finally:
        for process in busy:
            process.kill()
            process.wait()
    assert run.stdout.strip() == here
