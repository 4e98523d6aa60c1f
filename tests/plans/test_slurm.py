"""Plans by submitit's jobs: the dataset is that of the local executor, whatever happens to the jobs."""

import os
import signal
import subprocess
from pathlib import Path

import pytest

pytest.importorskip("submitit", reason='plans on Slurm need submitit: pip install -e ".[slurm]"')

from plan_stages import PLAN, assert_same, deaths_of, plan_faults, run_here
from slurm_runs import LOCAL, job_at, processes_of, run, start, wait_for

from robocas_ms3.core.errors import MissingExtraError, PlanError
from robocas_ms3.plans.executors import open_executor

SUPPORT = Path(__file__).resolve().parents[1] / "support"


@pytest.fixture(autouse=True)
def jobs_know_the_made_up_episodes(monkeypatch):
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(SUPPORT), os.environ.get("PYTHONPATH", "")]))


@pytest.mark.parametrize("units_per_job", [1, 2])
def test_jobs_make_what_this_machine_makes(undisturbed, tmp_path, units_per_job):
    out = tmp_path / "out"
    run(out, LOCAL | {"units_per_job": str(units_per_job)})
    assert_same(undisturbed, out)
    wait_for(lambda: not processes_of(out))


SIGNALS = {"killed": signal.SIGKILL, "time is up": signal.SIGUSR2, "told to end": signal.SIGTERM}


@pytest.mark.parametrize("number", SIGNALS.values(), ids=SIGNALS)
def test_a_job_that_ends_costs_nothing_and_blames_no_seed(undisturbed, tmp_path, number):
    out = tmp_path / "out"
    plan_faults(out, {11: ["hang"]})
    runner = start(out, LOCAL, stderr=subprocess.PIPE)
    job = job_at(out, 11)
    for process in [*reversed(job.children(recursive=True)), job]:  # Slurm goes through them in no order
        process.send_signal(number)
    assert runner.wait(240) == 0, runner.stderr.read()
    assert_same(undisturbed, out)
    assert deaths_of(out) == []


def test_ctrl_c_ends_jobs_and_the_plan_continues_later(undisturbed, tmp_path):
    out = tmp_path / "out"
    plan_faults(out, {10: ["hang"]})
    runner = start(out, LOCAL, stderr=subprocess.DEVNULL)
    job_at(out, 10)
    runner.send_signal(signal.SIGINT)
    assert runner.wait(30) != 0
    wait_for(lambda: not processes_of(out), 30)
    assert not (out / "report.json").exists()
    run(out, LOCAL)
    assert_same(undisturbed, out)


def test_jobs_of_a_killed_run_do_no_harm(undisturbed, tmp_path):
    out = tmp_path / "out"
    runner = start(out, LOCAL, stderr=subprocess.DEVNULL)
    wait_for(lambda: list(out.glob("units/a/*/.*")))
    runner.kill()
    runner.wait()
    run_here(out)  # while they are at work, on this machine
    wait_for(lambda: not processes_of(out))
    run_here(out)
    assert_same(undisturbed, out)


def test_a_unit_whose_jobs_die_again_and_again_is_an_error_with_their_log(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(SUPPORT.parents[1]))  # no plan_stages in the jobs
    out = tmp_path / "out"
    with pytest.raises(PlanError) as error:
        run(out, LOCAL)
    assert error.value.where in ([out / "units" / "a" / name for name in ("00000", "00001")])
    log = Path(str(error.value.fix).split()[1].rstrip(";"))
    assert "plan_stages" in log.read_text()


def test_an_error_of_all_seeds_ends_the_run(undisturbed, tmp_path):
    out = tmp_path / "out"
    plan_faults(out, {13: ["refuse"]})
    with pytest.raises(MissingExtraError):
        run(out, LOCAL)
    wait_for(lambda: not processes_of(out), 30)
    run(out, LOCAL)
    assert_same(undisturbed, out)


@pytest.mark.parametrize("options", [{"partitoin": "x"}, {"units_per_job": "0"}, {"time": "2h"}, {"cluster": "pbs"}])
def test_invalid_options_are_refused(options):
    with pytest.raises(PlanError) as error:
        open_executor("slurm", PLAN, Path(), 1, options)
    assert str(error.value.where).startswith("--executor-option")


def test_without_slurm_the_executor_says_so(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(PlanError) as error:
        open_executor("slurm", PLAN, tmp_path, 1, {})
    assert error.value.where == "--executor slurm"


@pytest.fixture
def slurm(tmp_path, monkeypatch):
    """Made-up commands of Slurm; sets what one does, in the words of a shell."""
    folder = tmp_path / "bin"
    folder.mkdir()
    monkeypatch.setenv("PATH", f"{folder}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setattr("robocas_ms3.plans.executors.slurm._ASK", 0.0)

    def set_command(name, script):
        (folder / name).write_text(f"#!/bin/sh\n{script}\n")
        (folder / name).chmod(0o755)

    for name in ("sbatch", "srun", "squeue", "scancel"):
        set_command(name, "exit 0")
    set_command("sbatch", "echo 'Submitted batch job 7'")
    return set_command


@pytest.fixture
def executor(slurm, tmp_path):
    executor = open_executor("slurm", PLAN, tmp_path / "out", 2, {})
    executor.__enter__()
    return executor


def test_a_queue_that_does_not_answer_changes_nothing(executor, slurm, caplog):
    jobs = executor.submit([["one"], ["two"]])
    slurm("squeue", "exit 1")
    assert not any(job.done() for job in jobs)
    assert "squeue does not answer" in caplog.text
    slurm("squeue", "echo '7_0|None'")
    assert [job.done() for job in jobs] == [False, True]


def test_jobs_that_slurm_refuses_are_an_error_at_first_and_wait_later(executor, slurm):
    slurm("sbatch", "exit 1")
    with pytest.raises(PlanError) as error:
        executor.submit([["one"]])
    assert error.value.where == "sbatch"


def test_a_held_job_that_can_never_start_is_cancelled(executor, slurm, tmp_path):
    jobs = executor.submit([["one"], ["two"]])
    slurm("squeue", "echo '7_0|None'; echo '7_1|launch failed requeued held'")
    slurm("scancel", f"echo \"$@\" >>'{tmp_path}/cancelled'")
    assert [job.done() for job in jobs] == [False, True]
    assert (tmp_path / "cancelled").read_text().split()[0] == "7_1"


def test_a_slow_scancel_is_not_cut_off(executor, slurm, tmp_path):
    slurm("scancel", f"sleep 2.5; touch '{tmp_path}/cancelled'")
    executor.__exit__()
    assert not (tmp_path / "cancelled").exists()
    wait_for((tmp_path / "cancelled").exists, 20)
