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

from plan_stages import PLAN, MadeUp, assert_same, render, stages
from ray.cluster_utils import Cluster

from robocas_ms3.core.errors import MissingExtraError, PlanError
from robocas_ms3.plans.engines import ray as engine
from robocas_ms3.plans.engines.ray import RayEngine
from robocas_ms3.plans.engines.ray_cluster import RayOptions, read_options
from robocas_ms3.plans.run import run_plan
from robocas_ms3.plans.slot import Stages
from robocas_ms3.plans.units import Unit

SUPPORT = Path(__file__).resolve().parents[1] / "support"

LEASE = 4.0


class Slow(MadeUp):
    """Takes its time for an episode, and notes of which unit it was, and when."""

    def __init__(self, notes, seconds, plan):
        super().__init__(plan)
        self.notes, self.seconds = notes, seconds

    def run(self, task):
        begun = time.time()
        time.sleep(self.seconds)
        made = super().run(task)
        with (self.notes / f"{os.getpid()}.jsonl").open("a") as file:
            file.write(json.dumps([task.folder.name, task.part, begun, time.time()]) + "\n")
        return made


def slow_stages(notes, seconds=1.0):
    notes.mkdir()
    return Stages(partial(Slow, notes, seconds), render)


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


@pytest.fixture(autouse=True)
def quickly(monkeypatch):
    """Moments instead of half minutes."""
    monkeypatch.setattr(engine, "LEASE", LEASE)
    monkeypatch.setattr(engine, "ENDING", 2.0)
    monkeypatch.setattr(engine, "_BEAT", 0.5)


@pytest.fixture
def slots(cluster):
    """Two nodes, whatever a test did to them; gives the processes of the actors."""
    while len([node for node in ray_nodes(cluster) if node["Alive"]]) < 2:
        cluster.second = cluster.add_node(num_cpus=1)
    return lambda: [found for found in psutil.process_iter() if _name(found).startswith("ray::RaySlot")]


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


def run(cluster, out, gather, stages, jobs=2, **more):
    options = {"address": cluster.address, "gather": "yes" if gather else "no"}
    return run_plan(PLAN, out, lambda plan, out: RayEngine(plan, out, jobs, options, stages), **more)


def once(out, happen):
    """Have something happen as soon as an episode is there, in a thread."""

    def wait():
        until = time.monotonic() + 60
        while not any(path.stat().st_size for path in (out / "units").glob("*/*/seeds.jsonl")):
            assert time.monotonic() < until
            time.sleep(0.05)
        happen()

    thread = Thread(target=wait)
    thread.start()
    return thread


def homes():
    """Folders that actors have on this machine."""
    return list(Path(os.environ["TMPDIR"]).glob("robocas-ray-*"))


GATHER = pytest.mark.parametrize("gather", [False, True], ids=["shared", "gather"])


@GATHER
def test_two_nodes_make_what_this_process_makes(cluster, slots, undisturbed, tmp_path, gather):
    run(cluster, tmp_path / "out", gather, stages())
    assert_same(undisturbed, tmp_path / "out")
    assert slots() == []
    assert homes() == []


@GATHER
def test_an_actor_that_is_killed_costs_nothing(cluster, slots, undisturbed, tmp_path, gather):
    out, killed = tmp_path / "out", []

    def kill():
        for process in slots()[:1]:
            process.kill()
            killed.append(process.pid)

    thread = once(out, kill)
    run(cluster, out, gather, slow_stages(tmp_path / "notes"))
    thread.join()
    assert killed
    assert_same(undisturbed, out)
    assert_one_at_a_time(tmp_path / "notes")


@GATHER
def test_a_node_that_is_lost_costs_nothing(cluster, slots, undisturbed, tmp_path, gather):
    out, lost = tmp_path / "out", []

    def lose():
        on_it = [found.pid for found in slots() if found.ppid() == raylet(cluster).pid]
        cluster.remove_node(cluster.second, allow_graceful=False)
        lost.extend(on_it)

    thread = once(out, lose)
    run(cluster, out, gather, slow_stages(tmp_path / "notes"))
    thread.join()
    assert lost
    assert_same(undisturbed, out)
    assert_one_at_a_time(tmp_path / "notes")


def test_an_actor_that_is_cut_off_and_lives_ends_before_another_is_at_its_unit(
    cluster, slots, undisturbed, tmp_path, monkeypatch
):
    """Its node is frozen, so that the cluster gives it up; it goes on, until its lease is over."""
    out, node = tmp_path / "out", raylet(cluster)
    doomed, at_loss, at_return = [], [], []
    again, end = RayEngine._again, engine._Actor.end

    def living():
        return [process.pid for process in doomed if _name(process)]  # a zombie has none

    def note_return(self, job, error):
        at_return.append(living())
        again(self, job, error)

    def note_loss(actor):
        at_loss.append(living())
        end(actor)

    def cut_off():
        doomed.extend(found for found in slots() if found.ppid() == node.pid)
        node.suspend()

    monkeypatch.setattr(RayEngine, "_again", note_return)
    monkeypatch.setattr(engine._Actor, "end", note_loss)
    thread = once(out, cut_off)
    try:
        run(cluster, out, False, slow_stages(tmp_path / "notes", 5.0))
        thread.join()
        assert at_loss[0] == [process.pid for process in doomed] != []  # it lived when it was given up
        assert at_return == [[]]  # and did not when its unit was handed on
    finally:
        node.resume()
        cluster.remove_node(cluster.second, allow_graceful=False)
    assert_same(undisturbed, out)
    assert_one_at_a_time(tmp_path / "notes")


def raylet(cluster):
    (process,) = cluster.second.all_processes["raylet"]
    return psutil.Process(process.process.pid)


def assert_one_at_a_time(notes):
    spans = {}
    for path in notes.iterdir():
        for folder, part, begun, ended in map(json.loads, path.read_text().splitlines()):
            spans.setdefault((part, folder), []).append((begun, ended))
    for found in spans.values():
        found.sort()
        assert all(before[1] <= after[0] for before, after in zip(found, found[1:], strict=False))


def test_options_are_read_or_refused():
    assert read_options({"num_gpus": "0.25", "gather": "yes", "address": "10.0.0.1:6379"}) == RayOptions(
        num_gpus=0.25, gather=True, address="10.0.0.1:6379"
    )
    with pytest.raises(PlanError, match="expected address, num_cpus, num_gpus, gather, found .'cpus'"):
        read_options({"cpus": "2"})
    with pytest.raises(PlanError, match="num_cpus"):
        read_options({"num_cpus": "0"})
    with pytest.raises(PlanError, match="gather"):
        read_options({"gather": "perhaps"})


def test_a_cluster_that_is_not_there_is_said(tmp_path):
    with pytest.raises(PlanError, match="no cluster of Ray answers"):
        RayEngine(PLAN, tmp_path, 1, {"address": "127.0.0.1:1"})
    with pytest.raises(PlanError, match="Ray's client can't do this"):
        RayEngine(PLAN, tmp_path, 1, {"address": "ray://127.0.0.1:1"})


@GATHER
def test_an_error_of_all_seeds_ends_the_plan_in_one_line(cluster, slots, tmp_path, gather):
    with pytest.raises(MissingExtraError, match="nothing to record with"):
        run(cluster, tmp_path / "out", gather, Stages(Lacking, render))
    assert slots() == []


class Lacking(MadeUp):
    """Meets the same at every seed."""

    def run(self, task):
        raise MissingExtraError("nothing to record with")


def test_a_unit_that_goes_on_killing_its_actors_ends_the_plan(cluster, slots, tmp_path):
    with pytest.raises(PlanError, match="the actors of Ray that were at this unit died .found 3 times"):
        run(cluster, tmp_path / "out", True, Stages(Deadly, render), jobs=1)
    assert slots() == []


class Deadly(MadeUp):
    """Kills the actor at the second seed."""

    def run(self, task):
        if task.seed == 11:
            os.kill(os.getppid(), signal.SIGKILL)
            time.sleep(60)
        return super().run(task)


def test_nodes_that_do_not_see_the_folder_are_said(cluster, slots, tmp_path):
    ray_engine = RayEngine(PLAN, tmp_path / "elsewhere", 1, {"address": cluster.address}, stages())
    try:
        assert ray_engine.lingers == LEASE + 2.0
        with pytest.raises(PlanError, match="does not see the folder.*gather=yes"):
            ray_engine.submit(Unit(0, 0)).result(timeout=60)
    finally:
        ray_engine.close()


@pytest.mark.parametrize("ending", [signal.SIGINT, signal.SIGKILL])
@pytest.mark.parametrize("own", [False, True], ids=["a cluster", "one of its own"])
def test_ended_it_leaves_no_process_and_goes_on_later(cluster, slots, undisturbed, tmp_path, ending, own):
    out = tmp_path / "out"
    options = {} if own else {"address": cluster.address}
    here = [sys.executable, __file__, str(out), json.dumps(options)]
    before = {found.pid for found in psutil.process_iter()}
    process = subprocess.Popen(here, start_new_session=True, stderr=subprocess.DEVNULL)
    once(out, lambda: process.send_signal(ending)).join()
    ended = time.monotonic()
    process.wait()
    # Ray's own agents, which work on nothing, look but once a minute or so whether who started them was killed
    idle = AGENTS if ending == signal.SIGKILL else set()
    while slots() or (own and {_name(one).partition(" ")[0] for one in _of_ray(before)} - idle):
        assert time.monotonic() < ended + (3 if ending == signal.SIGINT else 30), slots()
        time.sleep(0.05)
    run(cluster, out, False, stages(), resume=True)
    assert_same(undisturbed, out)


AGENTS = {"ray::DashboardAgent", "ray::RuntimeEnvAgent"}


def _of_ray(before):
    words = ("raylet", "gcs_server", "ray::", "spawn_main")
    started = [found for found in psutil.process_iter() if found.pid not in before]
    return [found for found in started if any(word in _name(found) for word in words)]


if __name__ == "__main__":
    sys.path.insert(0, str(SUPPORT))
    run_plan(PLAN, Path(sys.argv[1]), lambda plan, out: RayEngine(plan, out, 2, json.loads(sys.argv[2]), stages()))
