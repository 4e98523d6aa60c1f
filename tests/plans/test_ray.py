"""Plans on a cluster of Ray: two nodes on this machine make what one process makes, whatever befalls them."""

import json
import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from threading import Thread

import psutil
import pytest

ray = pytest.importorskip("ray", reason="needs the ray extra: plans on a cluster of Ray are NOT tested")

from plan_stages import PLAN, MadeUp, assert_same, open_worker, render, run_here
from ray.cluster_utils import Cluster

from robocas_ms3.core.errors import MissingExtraError, PlanError
from robocas_ms3.plans.executors.ray import RayExecutor, RayOptions, do_units
from robocas_ms3.plans.run import run_plan
from robocas_ms3.plans.units import Unit
from robocas_ms3.plans.worker import UnitWorker

SUPPORT = Path(__file__).resolve().parents[1] / "support"


class Acting(MadeUp):
    """Does something before it writes a recording."""

    def __init__(self, act, plan):
        super().__init__(plan)
        self.act = act

    def run(self, files):
        self.act(files)
        return super().run(files)


def wait_a_second(files):
    time.sleep(1.0)


def lack_an_extra(files):
    raise MissingExtraError("nothing to record with")


def kill_task_at_second_seed(files):
    if files.seed == 11:
        os.kill(os.getppid(), signal.SIGKILL)
        time.sleep(60)


def open_acting(act, plan, out):
    return UnitWorker(plan, out, partial(Acting, act), render)


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    before = dict(os.environ)
    path = os.environ.get("PYTHONPATH", "")
    os.environ |= {
        "RAY_USAGE_STATS_ENABLED": "0",
        "RAY_TMPDIR": "/tmp",  # paths of sockets are short
        "TMPDIR": f"{tmp_path_factory.mktemp('node')}",
        "PYTHONPATH": os.pathsep.join(map(str, (SUPPORT, Path(__file__).parent, path))),
    }
    quick = {"health_check_initial_delay_ms": 0, "health_check_period_ms": 500, "health_check_timeout_ms": 500}
    head = {"num_cpus": 1, "include_dashboard": False, "_system_config": quick | {"health_check_failure_threshold": 6}}
    cluster = Cluster(initialize_head=True, head_node_args=head)
    cluster.second = cluster.add_node(num_cpus=1)
    yield cluster
    cluster.shutdown()
    os.environ.clear()
    os.environ |= before


@pytest.fixture
def tasks(cluster):
    """Two nodes, whatever a test did to them; gives the processes that do units."""
    while len([node for node in ray_nodes(cluster) if node["Alive"]]) < 2:
        cluster.second = cluster.add_node(num_cpus=1)
    return lambda: [found for found in psutil.process_iter() if _name(found).startswith(("ray::do_", "ray::send_"))]


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


def run(cluster, out, gather, open_worker=open_worker, jobs=2):
    options = {"address": cluster.address, "gather": "yes" if gather else "no", "units_per_job": "1"}
    return run_plan(RayExecutor(PLAN, out, jobs, options, open_worker))


def once(out, happen):
    """Have something happen as soon as an episode is there, in a thread."""

    def wait():
        until = time.monotonic() + 60
        while not list((out / "units").glob("*/*/[0-9]*")):
            assert time.monotonic() < until
            time.sleep(0.05)
        happen()

    thread = Thread(target=wait)
    thread.start()
    return thread


def homes():
    """Temporary folders of tasks on this machine."""
    return list(Path(os.environ["TMPDIR"]).glob("robocas-ray-*"))


GATHER = pytest.mark.parametrize("gather", [False, True], ids=["shared", "gather"])


@GATHER
def test_two_nodes_make_what_this_process_makes(cluster, tasks, undisturbed, tmp_path, gather):
    run(cluster, tmp_path / "out", gather)
    assert_same(undisturbed, tmp_path / "out")
    assert tasks() == []
    assert homes() == []


@GATHER
def test_a_task_that_is_killed_costs_nothing(cluster, tasks, undisturbed, tmp_path, gather):
    out, killed = tmp_path / "out", []

    def kill():
        for process in tasks()[:1]:
            process.kill()
            killed.append(process.pid)

    thread = once(out, kill)
    run(cluster, out, gather, partial(open_acting, wait_a_second))
    thread.join()
    assert killed
    assert_same(undisturbed, out)


@GATHER
def test_a_node_that_is_lost_costs_nothing(cluster, tasks, undisturbed, tmp_path, gather):
    out = tmp_path / "out"
    thread = once(out, lambda: cluster.remove_node(cluster.second, allow_graceful=False))
    run(cluster, out, gather, partial(open_acting, wait_a_second))
    thread.join()
    assert_same(undisturbed, out)


def test_a_task_that_is_cut_off_and_lives_does_no_harm(cluster, tasks, undisturbed, tmp_path):
    """Its node is frozen, so that the cluster gives it up; the task goes on, while another one does its units."""
    out, node = tmp_path / "out", raylet(cluster)
    thread = once(out, node.suspend)
    try:
        run(cluster, out, False, partial(open_acting, wait_a_second))
        thread.join()
    finally:
        node.resume()
        cluster.remove_node(cluster.second, allow_graceful=False)
    run_here(out)
    assert_same(undisturbed, out)


def raylet(cluster):
    (process,) = cluster.second.all_processes["raylet"]
    return psutil.Process(process.process.pid)


def test_options_are_read_or_refused():
    options = {"num_gpus": "0.25", "gather": "yes", "address": "10.0.0.1:6379"}
    expected = RayOptions(num_gpus=0.25, gather=True, address="10.0.0.1:6379")
    assert RayExecutor(PLAN, Path(), options=options).options == expected
    for options in ({"cpus": "2"}, {"num_cpus": "0"}, {"gather": "perhaps"}):
        with pytest.raises(PlanError) as error:
            RayExecutor(PLAN, Path(), options=options)
        assert str(error.value.where).startswith("--executor-option")


@pytest.mark.parametrize("address", ["127.0.0.1:1", "ray://127.0.0.1:1"])
def test_a_cluster_that_is_not_there_is_an_error(tmp_path, address):
    with pytest.raises(PlanError, match=address), RayExecutor(PLAN, tmp_path, options={"address": address}):
        pass


@GATHER
def test_an_error_of_all_seeds_ends_the_plan(cluster, tasks, tmp_path, gather):
    with pytest.raises(MissingExtraError):
        run(cluster, tmp_path / "out", gather, partial(open_acting, lack_an_extra))
    assert tasks() == []


@GATHER
def test_a_unit_that_goes_on_killing_its_tasks_ends_the_plan(cluster, tasks, tmp_path, gather):
    with pytest.raises(PlanError, match="the jobs of this unit die") as error:
        run(cluster, tmp_path / "out", gather, partial(open_acting, kill_task_at_second_seed), jobs=1)
    assert error.value.where == Unit(0, 0).folder(PLAN, tmp_path / "out")
    assert tasks() == []


def test_a_node_that_does_not_see_the_folder_is_an_error(tmp_path, monkeypatch):
    monkeypatch.setattr("robocas_ms3.plans.executors.ray._APPEARS", 0.0)
    with pytest.raises(PlanError, match="gather=yes"):
        do_units(PLAN, tmp_path / "elsewhere", [Unit(0, 0)], open_worker)


@pytest.mark.parametrize("ending", [signal.SIGINT, signal.SIGKILL])
@pytest.mark.parametrize("own", [False, True], ids=["a cluster", "one of its own"])
def test_ended_it_leaves_no_process_and_continues_later(cluster, tasks, undisturbed, tmp_path, ending, own):
    out = tmp_path / "out"
    options = {} if own else {"address": cluster.address}
    here = [sys.executable, __file__, str(out), json.dumps(options)]
    before = {found.pid for found in psutil.process_iter()}
    process = subprocess.Popen(here, start_new_session=True, stderr=subprocess.DEVNULL)
    once(out, lambda: process.send_signal(ending)).join()
    process.wait(60)
    ended = time.monotonic()
    # Ray's own agents, which work on nothing, look but once a minute or so whether who started them was killed
    idle = AGENTS if ending == signal.SIGKILL else set()
    while tasks() or (own and {_name(one).partition(" ")[0] for one in _of_ray(before)} - idle):
        assert time.monotonic() < ended + 30, tasks()
        time.sleep(0.05)
    run(cluster, out, False)
    assert_same(undisturbed, out)


AGENTS = {"ray::DashboardAgent", "ray::RuntimeEnvAgent"}


def _of_ray(before):
    words = ("raylet", "gcs_server", "ray::", "spawn_main")
    started = [found for found in psutil.process_iter() if found.pid not in before]
    return [found for found in started if any(word in _name(found) for word in words)]


if __name__ == "__main__":
    sys.path.insert(0, str(SUPPORT))
    run_plan(RayExecutor(PLAN, Path(sys.argv[1]), 2, json.loads(sys.argv[2]), open_worker))
