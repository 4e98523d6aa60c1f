"""Calls of the commands of Slurm, which are replaced by shell scripts, and reactions to their output."""

import os
import time

import pytest

pytest.importorskip("submitit", reason='plans on Slurm need submitit: pip install -e ".[slurm]"')

from plan_stages import PLAN

from robocas_ms3.core.errors import PlanError
from robocas_ms3.plans.executors import open_executor
from robocas_ms3.plans.folder import PlanFolder


def test_missing_slurm_is_an_error(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(PlanError) as error:
        open_executor("slurm", PlanFolder(PLAN, tmp_path), 1, {})
    assert error.value.where == "--executor slurm"


@pytest.fixture
def slurm(tmp_path, monkeypatch):
    """Replace the commands of Slurm; return a function that sets the shell script of a command."""
    folder = tmp_path / "bin"
    folder.mkdir()
    monkeypatch.setenv("PATH", f"{folder}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setattr("robocas_ms3.plans.executors.slurm._QUEUE_INTERVAL", 0.0)

    def set_command(name, script):
        (folder / name).write_text(f"#!/bin/sh\n{script}\n")
        (folder / name).chmod(0o755)

    for name in ("sbatch", "srun", "squeue", "scancel"):
        set_command(name, "exit 0")
    set_command("sbatch", "echo 'Submitted batch job 7'")
    return set_command


@pytest.fixture
def executor(slurm, tmp_path):
    executor = open_executor("slurm", PlanFolder(PLAN, tmp_path / "out"), 2, {})
    executor.__enter__()
    return executor


def test_squeue_without_answer_ends_no_job(executor, slurm, caplog):
    jobs = executor.submit([["one"], ["two"]])
    slurm("squeue", "exit 1")
    assert not any(job.done() for job in jobs)
    assert "squeue does not answer" in caplog.text
    slurm("squeue", "echo '7_0|None'")
    assert [job.done() for job in jobs] == [False, True]


def test_rejected_jobs_are_an_error_at_first_and_retried_later(executor, slurm):
    slurm("sbatch", "exit 1")
    with pytest.raises(PlanError) as error:
        executor.submit([["one"]])
    assert error.value.where == "sbatch"


def test_held_job_is_cancelled(executor, slurm, tmp_path):
    jobs = executor.submit([["one"], ["two"]])
    slurm("squeue", "echo '7_0|None'; echo '7_1|launch failed requeued held'")
    slurm("scancel", f"echo \"$@\" >>'{tmp_path}/cancelled'")
    assert [job.done() for job in jobs] == [False, True]
    assert (tmp_path / "cancelled").read_text().split()[0] == "7_1"


def test_slow_scancel_is_not_killed(executor, slurm, tmp_path):
    slurm("scancel", f"sleep 2.5; touch '{tmp_path}/cancelled'")
    executor.__exit__()
    assert not (tmp_path / "cancelled").exists()
    until = time.monotonic() + 20
    while not (tmp_path / "cancelled").exists():
        assert time.monotonic() < until
        time.sleep(0.05)
