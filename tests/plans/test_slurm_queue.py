"""What the engine says and does where commands of Slurm fail or are slow; made-up commands take their place."""

import os
import time

import pytest

pytest.importorskip("submitit", reason='the engine slurm needs submitit: pip install -e ".[slurm]"')

from plan_stages import PLAN

from robocas_ms3.plans.driver import current_run, new_run
from robocas_ms3.plans.engines import slurm_queue
from robocas_ms3.plans.engines.slurm import SlurmEngine
from robocas_ms3.plans.engines.slurm_options import read_options
from robocas_ms3.plans.units import Unit


@pytest.fixture
def command(tmp_path, monkeypatch):
    """Sets what a command does, in the words of a shell."""
    folder = tmp_path / "bin"
    folder.mkdir()
    monkeypatch.setenv("PATH", f"{folder}{os.pathsep}{os.environ['PATH']}")

    def set_command(name, script):
        (folder / name).write_text(f"#!/bin/sh\n{script}\n")
        (folder / name).chmod(0o755)

    for name in ("sbatch", "srun", "squeue", "scancel"):
        set_command(name, "exit 0")
    return set_command


@pytest.fixture
def queue(command, tmp_path, monkeypatch):
    monkeypatch.setattr(slurm_queue, "_ASK", 0.0)
    return slurm_queue.open_queue(read_options({}), tmp_path / "out", 1, 1.0)


def test_a_queue_that_does_not_answer_is_a_warning_each_time_it_begins(queue, command, caplog):
    for script, alive, warnings in (
        ("exit 1", None, 1),
        ("exit 1", None, 1),
        ("echo '7_0|None'", {"7_0"}, 1),
        ("exit 1", None, 2),
    ):
        command("squeue", script)
        assert queue.alive(()) == alive
        assert [record.levelname for record in caplog.records] == ["WARNING"] * warnings
    assert "squeue does not answer" in caplog.text


def test_a_queue_that_takes_too_long_counts_as_one_that_does_not_answer(queue, command, caplog, monkeypatch):
    monkeypatch.setattr(slurm_queue, "_ANSWER", 0.5)
    command("squeue", "exec sleep 60")
    assert queue.alive(()) is None
    assert "squeue does not answer" in caplog.text


def test_a_slow_scancel_is_not_waited_for_and_not_cut_off(queue, command, tmp_path, caplog):
    command("scancel", f"sleep 2.5; touch '{tmp_path}/cancelled'")
    begun = time.monotonic()
    queue.cancel()
    assert time.monotonic() - begun < 2.4
    until = time.monotonic() + 20
    while not (tmp_path / "cancelled").exists():
        assert time.monotonic() < until
        time.sleep(0.05)
    assert caplog.text == ""


def test_a_scancel_that_fails_is_a_warning_that_can_be_typed_again(queue, command, caplog):
    command("scancel", "exit 1")
    queue.cancel()
    assert "jobs of this plan may be left: scancel --quiet --name=robocas-out-" in caplog.text


def test_a_held_job_that_can_never_start_is_cancelled(queue, command, tmp_path):
    command("squeue", "echo '7_0|None'; echo '7_1|launch failed requeued held'")
    command("scancel", f"echo \"$@\" >>'{tmp_path}/cancelled'")
    assert queue.alive(()) == {"7_0"}
    assert (tmp_path / "cancelled").read_text() == "7_1\n"


def test_ctrl_c_while_sbatch_is_slow_lets_the_jobs_leave_by_themselves(command, tmp_path):
    out = tmp_path / "out"
    command("sbatch", f"touch '{tmp_path}/asked'; sleep 1.5; echo 'Submitted batch job 7'")
    with new_run(out) as run:
        engine = SlurmEngine(PLAN, out, 1)
        engine.submit(Unit(0, 0))
        until = time.monotonic() + 20
        while not (tmp_path / "asked").exists():
            assert time.monotonic() < until
            time.sleep(0.05)
        assert (current_run(out) or run).name == run.name
        engine.close()
        assert current_run(out) is None  # what a job looks for when it begins


def test_many_units_are_looked_at_less_often(command, tmp_path):
    engine = SlurmEngine(PLAN, tmp_path / "out", 1)
    engine.close()
    few = engine._pause()
    engine._jobs = [type("Job", (), {"units": [None] * 1000})] * 2
    assert engine._pause() == 10.0 > few == 0.5
