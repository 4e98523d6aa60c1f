"""Who may run a plan in a folder, and what becomes of jobs of a run that is over."""

import errno
import json
import os
import socket
import threading
import time
from concurrent.futures import Future
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import pytest
from plan_stages import PLAN

from robocas_ms3.core.errors import PlanError
from robocas_ms3.core.files import write_json
from robocas_ms3.plans import claims, driver
from robocas_ms3.plans import run as module
from robocas_ms3.plans.begun import check_plan_of, content_of, read_plan
from robocas_ms3.plans.claims import claimed
from robocas_ms3.plans.driver import Run, current_run, is_current, new_run, sole, wait_for_killed, who_runs
from robocas_ms3.plans.engines import open_engine, slurm_job
from robocas_ms3.plans.engines.slurm_job import UnitsJob
from robocas_ms3.plans.run import run_plan
from robocas_ms3.plans.units import CLAIMS, Outcome, Unit

ENGINES = ("local", "slurm", "ray")
FLAGS = [{}, {"resume": True}, {"overwrite": True}]


class AtOnce:
    """An engine all of whose units are done at once, of which no files come."""

    slots, lingers = 2, 35.0

    def __init__(self, plan, out):
        self.plan, self.out, self.seen = plan, out, []

    def submit(self, unit):
        self.seen.append(json.loads((self.out / ".driver.run").read_text()))
        future = Future()
        future.set_result([Outcome(seed, True) for seed in unit.seeds(self.plan)])
        return future

    def close(self):
        self.seen.append(current_run(self.out))


@pytest.fixture
def run(monkeypatch):
    """Runs the plan by such an engine; what else is written is `plan.json`."""
    monkeypatch.setattr(module, "_damaged", lambda *_: {})
    monkeypatch.setattr(module, "join", lambda *_, **__: {"episodes": 7})
    return lambda out, plan=PLAN, engine=AtOnce, **more: run_plan(plan, out, engine, **more)


def begun(out, plan=PLAN):
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / "plan.json", content_of(plan))
    return out


def names(folder):
    return {path.name for path in folder.iterdir()}


def claim_of(host=None, boot=None, lease=60.0):
    boot = boot or (claims._BOOT.read_text().strip() if claims._BOOT.is_file() else "-")
    return f"{host or socket.gethostname()} 4242 abc {lease} {boot}"


def age(claim, seconds):
    at = time.time() - seconds
    os.utime(claim, (at, at))


def no_locks(*_):
    raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))


def test_a_claim_of_this_machine_is_taken_over_only_where_a_lock_says_that_nobody_is_there(tmp_path, run, monkeypatch):
    out = begun(tmp_path / "out")
    (out / ".driver.3").write_text(claim_of())
    with monkeypatch.context() as patch:
        patch.setattr("fcntl.flock", no_locks)
        for flags in FLAGS[1:]:
            with pytest.raises(PlanError, match=r"another process runs this plan .found .*, \d s ago"):
                run(out, **flags)
        assert names(out) == {".driver.3", "plan.json"}
        age(out / ".driver.3", 100)
        run(out, resume=True)
    (out / ".driver.3").write_text(claim_of())
    run(out, resume=True)
    assert names(out) == {"plan.json", "units"}


def test_two_machines_of_one_name_are_two(tmp_path, run):
    out = begun(tmp_path / "out")
    (out / ".driver.3").write_text(claim_of(boot="another-one"))
    with pytest.raises(PlanError, match="another machine runs this plan"):
        run(out, resume=True)


@pytest.mark.parametrize("flags", FLAGS)
def test_a_run_killed_before_it_said_what_it_is_is_in_nobodys_way(tmp_path, run, flags):
    out = tmp_path / "out"
    out.mkdir()
    (out / ".driver.1").write_text("")  # killed in the middle of that
    (out / ".plan.4242.tmp.json").write_text("{")
    (out / ".driver.tabc.tmp").write_text("")
    run(out, **flags)
    assert names(out) == {"plan.json", "units"}


def test_a_full_disk_before_it_said_what_it_is_leaves_nothing(tmp_path, run, monkeypatch):
    def full(*_, **__):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch, pytest.raises(OSError, match="No space"):
        patch.setattr(module, "write_json", full)
        run(tmp_path / "out")
    assert names(tmp_path / "out") == set()
    with pytest.raises(ZeroDivisionError):
        run(tmp_path / "out", engine=lambda *_: 1 / 0)
    assert names(tmp_path / "out") == {"plan.json"}


def test_to_go_on_and_to_begin_again_exclude_each_other(tmp_path, run):
    out = begun(tmp_path / "out")
    (out / "mine").touch()
    with pytest.raises(PlanError, match="plan run: these exclude each other .*found --resume --overwrite"):
        run(out, resume=True, overwrite=True)
    assert names(out) == {"plan.json", "mine"}


@pytest.mark.parametrize("engine", ENGINES)
def test_nothing_is_deleted_where_a_job_of_slurm_is_at_work(tmp_path, run, engine):
    out = begun(tmp_path / "out")
    with claimed(out / CLAIMS / "a" / "00000"):
        with pytest.raises(PlanError, match="jobs of Slurm are at this plan"):
            run(out, engine=lambda plan, out: open_engine(engine, plan, out, 1, {}), overwrite=True)
        assert (out / CLAIMS / "a" / "00000.1").is_file()


def test_limits_and_the_description_may_change_when_it_goes_on(tmp_path, run):
    out = begun(tmp_path / "out")
    limits = PLAN.limits.model_copy(update={"memory_gb": 7.0})
    run(out, PLAN.model_copy(update={"limits": limits, "description": "mended"}), resume=True)
    found = read_plan(out)
    assert (found.limits.memory_gb, found.description) == (7.0, "mended")
    with pytest.raises(PlanError, match="begun with another plan .found block: 3, now 4"):
        run(out, PLAN.model_copy(update={"block": 4}), resume=True)


def test_a_run_has_an_id_for_as_long_as_it_is_at_units(tmp_path, run):
    engines = []

    def engine(plan, out):
        assert current_run(out) is not None
        engines.append(AtOnce(plan, out))
        return engines[-1]

    for flags in FLAGS:
        run(tmp_path / "out", engine=engine, **flags)
    ids = {one.seen[-1].name for one in engines}
    assert len(ids) == 3
    for one in engines:
        assert {about["run"] for about in one.seen[:-1]} == {one.seen[-1].name}
        assert one.seen[0]["lingers"] == 35.0  # before anything is begun
    assert names(tmp_path / "out") == {"plan.json", "units"}


def test_a_run_ends_no_other_one(tmp_path):
    with new_run(tmp_path):
        Run(tmp_path, "later").write()
    assert is_current(tmp_path, "later", 0.0)
    assert not is_current(tmp_path, "earlier", 0.0)


def test_another_id_may_be_one_that_is_not_seen_yet(tmp_path, monkeypatch):
    Run(tmp_path, "earlier").write()
    monkeypatch.setattr(time, "sleep", lambda _: Run(tmp_path, "mine").write())
    assert is_current(tmp_path, "mine")


@pytest.fixture
def job(tmp_path, monkeypatch):
    """A job of two units that a run wants which is the current one."""
    out = begun(tmp_path / "out")
    Run(out, "mine").write()
    monkeypatch.setattr(slurm_job, "is_current", partial(is_current, seconds=0.1))
    monkeypatch.setattr(slurm_job.signal, "signal", lambda *_: None)
    return UnitsJob(PLAN, out, (Unit(1, 0), Unit(0, 0)), 5.0, "plan_stages:stages", "mine")


def test_a_job_that_waited_in_the_queue_leaves_if_its_run_is_over(job, caplog):
    Run(job.out, "another").write()
    assert job() is None
    assert not (job.out / "units").exists()
    assert not (job.out / CLAIMS).exists()
    assert "leaving: the run that wanted this job is over" in caplog.text


def test_a_job_leaves_between_two_units(job, monkeypatch):
    def do(engine, unit):
        future = Future()
        future.set_result([])
        done.append(unit)
        Run(job.out, "mine").end()
        return future

    done = []
    monkeypatch.setattr(slurm_job.LocalEngine, "submit", do)
    assert job() is None
    assert done == [Unit(1, 0)]


def test_a_job_looks_again_once_it_has_its_claim(job, monkeypatch):
    @contextmanager
    def claim(path, lease):
        Run(job.out, "another").write()  # it began, and found no claim
        yield

    monkeypatch.setattr(slurm_job, "claimed", claim)
    monkeypatch.setattr(slurm_job.LocalEngine, "submit", lambda *_: 1 / 0)
    assert job() is None


@pytest.mark.parametrize(("lingers", "seconds", "waits"), [(1.0, 0.0, True), (1.0, 3.0, False), (0.0, 0.0, False)])
def test_what_a_killed_run_began_elsewhere_is_waited_for(tmp_path, caplog, lingers, seconds, waits):
    out = begun(tmp_path / "out")
    Run(out, "killed").write(lingers)
    claim = out / ".driver.1"
    claim.write_text(claim_of(lease=5.0))
    age(claim, seconds)
    before = time.monotonic()
    wait_for_killed(out)
    took = time.monotonic() - before
    assert 1.2 < took < 3 if waits else took < 0.8  # 1 s, and a tenth of a lease between two renewals
    assert ("waiting for" in caplog.text) == waits
    os.utime(claim, (0, 0))  # it was given back
    before = time.monotonic()
    wait_for_killed(out)
    assert time.monotonic() - before < 0.5


def test_a_run_waits_before_it_deletes_anything(tmp_path, run, monkeypatch):
    out, slept = begun(tmp_path / "out"), []
    Run(out, "killed").write(35.0)
    (out / ".driver.1").write_text(claim_of())
    monkeypatch.setattr(driver.time, "sleep", lambda seconds: slept.append((seconds, (out / ".driver.1").exists())))
    run(out, overwrite=True)
    assert 35 < slept[0][0] <= 41
    assert slept[0][1]


def test_who_runs_a_plan_leaves_though_the_file_server_hangs(tmp_path, monkeypatch):
    left, over, utime, is_dir = threading.Event(), threading.Event(), os.utime, Path.is_dir

    def hang_utime(path, *more):
        if str(path).endswith(".driver.1") and not more:
            over.wait()
        utime(path, *more)

    def hang_is_dir(path):
        if path == tmp_path / "out":
            over.wait()
        return is_dir(path)

    with sole(tmp_path / "out" / ".driver", 1.0), monkeypatch.context() as patch:
        patch.setattr(os, "_exit", lambda code: left.set())
        patch.setattr(os, "utime", hang_utime)
        patch.setattr(Path, "is_dir", hang_is_dir)
        assert left.wait(3.0)
        over.set()


def test_many_units_are_looked_at_less_often(tmp_path, run, monkeypatch):
    monkeypatch.setattr(module, "_LOOK", 0.0)
    monkeypatch.setattr(AtOnce, "slots", 1)
    for looks_a_second, times in ((1e9, 3), (1e-6, 2)):  # the first and the last
        monkeypatch.setattr(module, "_LOOKS", looks_a_second)
        looks = []
        run(tmp_path / f"{times}", on_progress=looks.append)
        assert len(looks) == times


def test_a_configuration_that_was_edited_is_said_by_its_key(tmp_path):
    write_json(tmp_path / "plan.json", content_of(PLAN))
    parts = [*PLAN.parts]
    parts[1] = parts[1].model_copy(update={"episodes": 3, "config": {"objects": {"count": 6}}})
    said = r"found parts.1.config: 'pick_shelf_scattered', now .*; parts.1.episodes: 2, now 3"
    with pytest.raises(PlanError, match=said):
        check_plan_of(tmp_path, PLAN.model_copy(update={"parts": parts}))


def test_who_runs_a_plan_is_said_while_it_does(tmp_path):
    assert who_runs(tmp_path / "a") is None
    with sole(tmp_path / "a"):
        assert who_runs(tmp_path / "a") == socket.gethostname()
    assert who_runs(tmp_path / "a") is None


def test_a_part_has_no_units_larger_than_itself(tmp_path):
    assert [PLAN.block_of(part) for part in (0, 1)] == [3, 2]
    assert Unit(1, 1).seeds(PLAN) == range(5, 7)
    assert Unit(0, 1).seeds(PLAN) == range(13, 16)


def test_going_on_with_nothing_is_said(run, tmp_path, caplog):
    run(tmp_path / "out", PLAN.model_copy(update={"stages": ["demonstrations"]}), resume=True)
    assert "no plan was begun there, so it begins" in caplog.text
