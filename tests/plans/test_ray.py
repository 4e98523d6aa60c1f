"""Plans on a Ray cluster of two nodes on this machine, also when a task or node fails."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from threading import Thread

import psutil
import pytest

ray = pytest.importorskip("ray", reason="needs the ray extra: plans on a cluster of Ray are NOT tested")

from plan_stages import PLAN, assert_same, env_of_jobs, run_here

from robocas_ms3.core.errors import PlanError
from robocas_ms3.plans.executors.ray import RayExecutor, run_units
from robocas_ms3.plans.folder import PlanFolder, WorkUnit
from robocas_ms3.plans.run import run_plan

RUNNER = Path(__file__).resolve().parents[1] / "support" / "plan_runner.py"


@pytest.fixture
def nodes(cluster):
    """Return a cluster of two nodes; restart a node that a test has stopped."""
    while len([node for node in ray_nodes(cluster) if node["Alive"]]) < 2:
        cluster.second = cluster.add_node(num_cpus=1)
    return cluster


def ray_nodes(cluster):
    ray.init(cluster.address, log_to_driver=False)
    try:
        return ray.nodes()
    finally:
        ray.shutdown()


def _name(process):
    try:
        return " ".join(process.cmdline())
    except psutil.Error:
        return ""


def run(nodes, out, gather):
    options = {"address": nodes.address, "gather": "yes" if gather else "no", "units_per_job": "1"}
    return run_plan(RayExecutor(PlanFolder(PLAN, out), 2, options))


def once(out, happen):
    """Call a function in a thread as soon as an episode is complete."""

    def wait():
        until = time.monotonic() + 60
        while not list((out / "units").glob("*/*/[0-9]*")):
            assert time.monotonic() < until
            time.sleep(0.05)
        happen()

    thread = Thread(target=wait)
    thread.start()
    return thread


GATHER = pytest.mark.parametrize("gather", [False, True], ids=["shared", "gather"])


@GATHER
def test_lost_node_loses_no_episode(nodes, undisturbed, tmp_path, gather):
    out = tmp_path / "out"
    thread = once(out, lambda: nodes.remove_node(nodes.second, allow_graceful=False))
    run(nodes, out, gather)
    thread.join()
    assert_same(undisturbed, out)


def test_task_on_a_disconnected_node_does_no_harm(nodes, undisturbed, tmp_path):
    """The node is frozen, so Ray starts another task; then the first task continues with the same work units."""
    out, node = tmp_path / "out", raylet(nodes)
    thread = once(out, node.suspend)
    try:
        run(nodes, out, False)
        thread.join()
    finally:
        node.resume()
        nodes.remove_node(nodes.second, allow_graceful=False)
    run_here(out)
    assert_same(undisturbed, out)


def raylet(cluster):
    (process,) = cluster.second.all_processes["raylet"]
    return psutil.Process(process.process.pid)


@pytest.mark.parametrize("address", ["127.0.0.1:1", "ray://127.0.0.1:1"])
def test_missing_cluster_is_an_error(tmp_path, address):
    with pytest.raises(PlanError, match=address), RayExecutor(PlanFolder(PLAN, tmp_path), 1, {"address": address}):
        pass


def test_node_without_access_to_the_folder_is_an_error(tmp_path, monkeypatch):
    monkeypatch.setattr("robocas_ms3.plans.executors.ray._FOLDER_TIMEOUT", 0.0)
    with pytest.raises(PlanError, match="gather=yes"):
        run_units(PlanFolder(PLAN, tmp_path / "elsewhere"), [WorkUnit(0, 0)])


@pytest.mark.parametrize("ending", [signal.SIGINT, signal.SIGKILL])
def test_cluster_started_for_the_run_ends_with_it(undisturbed, tmp_path, ending):
    out = tmp_path / "out"
    before = {found.pid for found in psutil.process_iter()}
    environment = {**os.environ, **env_of_jobs()}
    command = [sys.executable, RUNNER, str(out), "ray"]
    process = subprocess.Popen(command, env=environment, start_new_session=True, stderr=subprocess.DEVNULL)
    once(out, lambda: process.send_signal(ending)).join()
    process.wait(60)
    ended = time.monotonic()
    # Ray's own agents, which work on nothing, look but once a minute or so whether who started them was killed
    idle = AGENTS if ending == signal.SIGKILL else set()
    while {_name(one).partition(" ")[0] for one in _of_ray(before)} - idle:
        assert time.monotonic() < ended + 30, _of_ray(before)
        time.sleep(0.05)
    run_here(out)
    assert_same(undisturbed, out)


AGENTS = {"ray::DashboardAgent", "ray::RuntimeEnvAgent"}


def _of_ray(before):
    words = ("raylet", "gcs_server", "ray::", "spawn_main")
    started = [found for found in psutil.process_iter() if found.pid not in before]
    return [found for found in started if any(word in _name(found) for word in words)]
