"""Plans by submitit's jobs: the outcome is the local engine's, whatever befalls the jobs."""

import signal
import subprocess
import time
from pathlib import Path

import pytest

pytest.importorskip("submitit", reason='the engine slurm needs submitit: pip install -e ".[slurm]"')

from plan_stages import PLAN, assert_same, plan_faults, stages
from slurm_runs import (
    LOCAL,
    NO_SLURM,
    SLURM,
    assert_done_once,
    holds,
    processes_of,
    run,
    slurm_answers,
    stages_in_jobs,
    start,
    wait_for,
)

from robocas_ms3.core.errors import MissingExtraError, PlanError
from robocas_ms3.plans.claims import refuse_claimed
from robocas_ms3.plans.engines import open_engine
from robocas_ms3.plans.engines.local import LocalEngine
from robocas_ms3.plans.run import run_plan
from robocas_ms3.plans.units import CLAIMS, Unit, deaths

EXECUTORS = [
    pytest.param(LOCAL, id="local"),
    pytest.param(
        SLURM,
        id="slurm",
        marks=[
            pytest.mark.slow,
            pytest.mark.skipif(not slurm_answers(), reason=NO_SLURM),
        ],
    ),
]


@pytest.fixture(autouse=True)
def jobs_know_the_stages(monkeypatch):
    stages_in_jobs(monkeypatch)


@pytest.mark.parametrize("options", EXECUTORS)
@pytest.mark.parametrize("units_per_job", [1, 2])
def test_jobs_make_what_this_machine_makes(undisturbed, tmp_path, options, units_per_job):
    out = tmp_path / "out"
    run(out, options | {"units_per_job": str(units_per_job)})
    assert_same(undisturbed, out)
    assert_done_once(out)
    wait_for(lambda: not processes_of(out))
    assert len(list((out / "slurm").glob("*_log.out"))) == {1: 3, 2: 2}[units_per_job]  # of three units


@pytest.mark.parametrize("options", EXECUTORS)
def test_a_job_that_is_killed_costs_nothing(undisturbed, tmp_path, options):
    out = tmp_path / "out"
    plan_faults(out, {11: ["hang"], 4: ["hang"]})
    runner = start(out, options, stderr=subprocess.PIPE)
    killed = set()
    for seed in (11, 4):
        tries = out.with_name(f"out-tries-{seed}")
        wait_for(tries.exists)
        for process in processes_of(out):
            if process.pid not in killed and holds(process, out, seed):
                killed.add(process.pid)
                process.kill()
    assert runner.wait(240) == 0, runner.stderr.read()
    assert killed
    assert_same(undisturbed, out)
    assert_done_once(out)
    assert [death for unit in (Unit(0, 0), Unit(1, 0)) for death in deaths(unit.folder(PLAN, out)).read()] == []


@pytest.mark.parametrize("number", [signal.SIGUSR2, signal.SIGTERM], ids=["time is up", "told to end"])
def test_a_signal_to_all_processes_of_a_job_is_blamed_on_no_seed(undisturbed, tmp_path, number):
    out = tmp_path / "out"
    plan_faults(out, {11: ["hang"]})
    runner = start(out, LOCAL)
    wait_for(out.with_name("out-tries-11").exists)
    (job,) = [process for process in processes_of(out) if holds(process, out, 11)]
    for process in [*reversed(job.children(recursive=True)), job]:  # Slurm goes through them in no order
        process.send_signal(number)
    assert runner.wait(240) == 0
    assert_same(undisturbed, out)
    assert_done_once(out)
    assert deaths(Unit(0, 0).folder(PLAN, out)).read() == []


@pytest.mark.parametrize("options", EXECUTORS)
def test_ctrl_c_ends_jobs_at_once_and_the_plan_goes_on_later(undisturbed, tmp_path, options):
    out = tmp_path / "out"
    plan_faults(out, {10: ["hang"]})
    runner = start(out, options, stderr=subprocess.DEVNULL)
    wait_for(out.with_name("out-tries-10").exists)
    begun = time.monotonic()
    runner.send_signal(signal.SIGINT)
    assert runner.wait(10) != 0
    assert time.monotonic() - begun < 5  # 3 s are promised, to a machine that has nothing else to do
    wait_for(lambda: not processes_of(out), 5)
    assert not (out / "report.json").exists()
    run(out, options, resume=True)
    assert_same(undisturbed, out)
    assert_done_once(out)


@pytest.mark.parametrize("options", EXECUTORS)
def test_jobs_of_a_killed_run_and_those_of_the_next_are_never_at_one_unit(undisturbed, tmp_path, options):
    out = tmp_path / "out"
    runner = start(out, options, stderr=subprocess.DEVNULL)
    wait_for(lambda: list((out / "slurm").glob("claims/a/*")))
    runner.kill()
    runner.wait()
    run(out, options, resume=True)
    assert_same(undisturbed, out)
    assert_done_once(out)


def test_jobs_of_a_killed_run_leave_once_another_engine_is_to_go_on(undisturbed, tmp_path):
    out = tmp_path / "out"
    runner = start(out, LOCAL | {"units_per_job": "2"}, stderr=subprocess.DEVNULL)
    wait_for(lambda: list((out / "slurm").glob("claims/a/*")))
    runner.kill()
    runner.wait()

    def open_local(plan, out):
        refuse_claimed(out / CLAIMS)  # as `open_engine`, which knows no made-up stages
        return LocalEngine(plan, out, 1, stages=stages())

    with pytest.raises(PlanError, match="jobs of Slurm are at this plan"):
        run_plan(PLAN, out, open_local, resume=True)
    wait_for(lambda: not processes_of(out))
    assert "leaving: the run that wanted this job is over" in "".join(
        path.read_text() for path in (out / "slurm").glob("*_log.out")
    )
    assert not Unit(0, 1).is_done(PLAN, out)
    run_plan(PLAN, out, open_local, resume=True)
    assert_same(undisturbed, out)
    assert_done_once(out)


def test_a_unit_whose_jobs_die_again_and_again_is_an_error_with_their_log(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).resolve().parents[2]))  # no plan_stages in the jobs
    with pytest.raises(PlanError, match=r"units/a/0000[01]: the jobs of this unit die .*2 in a row.*_log.out") as error:
        run(tmp_path / "out", LOCAL | {"tries": "2"})
    log = Path(str(error.value.fix).split()[1].rstrip(";"))
    assert "plan_stages" in log.read_text()


def test_an_error_of_all_seeds_crosses_over_and_ends_the_run(undisturbed, tmp_path):
    out = tmp_path / "out"
    plan_faults(out, {13: ["refuse"]})
    with pytest.raises(MissingExtraError, match="nothing to record with"):
        run(out, LOCAL)
    wait_for(lambda: not processes_of(out), 5)
    run(out, LOCAL, resume=True)
    assert_same(undisturbed, out)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"partitoin": "x"}, "no options of the engine slurm .expected executor, .*partition.*found .'partitoin'."),
        ({"units_per_job": "0"}, "units_per_job"),
        ({"time": "2h"}, "time"),
        ({"executor": "pbs"}, "'slurm' or 'local'"),
    ],
)
def test_options_that_are_wrong_are_refused(tmp_path, options, said):
    with pytest.raises(PlanError, match=said):
        open_engine("slurm", PLAN, tmp_path, 1, options)


def test_without_slurm_the_engine_says_so(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(PlanError, match="there is no Slurm here.*executor=local"):
        open_engine("slurm", PLAN, tmp_path, 1, {})
