"""All executors write the dataset of the local executor, also when their jobs are killed."""

import os
import signal
from pathlib import Path

import psutil
import pytest
from plan_jobs import Jobs, wait_for
from plan_stages import PLAN, assert_same, crashes_of, env_of_jobs, plan_faults, run_here

from robocas_ms3.core.errors import MissingExtraError, PlanError
from robocas_ms3.plans.executors import open_executor
from robocas_ms3.plans.folder import PlanFolder, WorkUnit


@pytest.fixture(params=["local", "slurm", "ray", "ray without a shared folder"])
def jobs(request, tmp_path, monkeypatch):
    name, *gather = request.param.split(maxsplit=1)
    plan_faults(tmp_path / "out", {})
    if name == "local":
        return Jobs(name)
    if name == "slurm":
        pytest.importorskip("submitit", reason='plans on Slurm need submitit: pip install -e ".[slurm]"')
        for variable, value in env_of_jobs().items():
            monkeypatch.setenv(variable, value)
        return Jobs(name, cluster="local")
    return Jobs(name, address=request.getfixturevalue("cluster").address, gather="yes" if gather else "no")


@pytest.mark.parametrize("units_per_job", ["1", "2"])
def test_two_jobs_write_the_same_dataset_as_one(jobs, undisturbed, tmp_path, units_per_job):
    if jobs.name == "local":
        pytest.skip("see test_run_plan.py")
    jobs.run(tmp_path / "out", units_per_job=units_per_job)
    assert_same(undisturbed, tmp_path / "out")
    wait_for(lambda: not jobs.processes(tmp_path / "out"))
    if jobs.name == "ray":
        assert list(Path(os.environ["TMPDIR"]).glob("robocas-ray-*")) == []  # folders of tasks


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGUSR2])
def test_killed_job_loses_no_episode_and_fails_no_seed(jobs, undisturbed, tmp_path, number):
    if jobs.name == "local":
        pytest.skip("its jobs are threads of the program")
    if jobs.name == "ray" and number != signal.SIGKILL:
        pytest.skip("signals of Slurm: the job is cancelled, its time is up")
    out = tmp_path / "out"
    tries = plan_faults(out, {11: ["hang"]})
    runner = jobs.start(out)
    wait_for(lambda: tries(11))
    job = psutil.Process(tries(11)[0]).parent()
    for process in [*reversed(job.children(recursive=True)), job]:  # Slurm goes through them in no order
        process.send_signal(number)
    assert runner.wait(240) == 0, runner.stderr.read()
    assert_same(undisturbed, out)
    assert crashes_of(out) == []


@pytest.mark.parametrize("ending", [signal.SIGINT, signal.SIGKILL])
def test_interrupted_run_continues(jobs, undisturbed, tmp_path, ending):
    out = tmp_path / "out"
    runner = jobs.start(out)
    wait_for(lambda: list(out.glob("units/a/*/[0-9]*")))
    (os.killpg if jobs.name == "local" else os.kill)(runner.pid, ending)
    said = runner.communicate(timeout=60)[1]
    assert runner.returncode != 0
    if ending == signal.SIGINT or jobs.name == "local":
        wait_for(lambda: not jobs.processes(out), 30)
    if ending == signal.SIGINT and jobs.name == "local":
        assert "KeyboardInterrupt" in said and said.count("Traceback") <= 1  # the runner's own
    run_here(out)  # next to jobs that nobody ended
    wait_for(lambda: not jobs.processes(out))
    run_here(out)
    assert_same(undisturbed, out)
    assert crashes_of(out) == []


def test_work_unit_that_kills_its_jobs_ends_the_run(jobs, tmp_path):
    if jobs.name == "local":
        pytest.skip("its jobs are threads of this process")
    out = tmp_path / "out"
    plan_faults(out, {11: ["kill job"] * 9})
    with pytest.raises(PlanError, match="all jobs of this work unit were killed") as error:
        jobs.run(out, units_per_job="1")
    assert error.value.where == PlanFolder(PLAN, out).unit_folder(WorkUnit(0, 0))
    if jobs.name == "slurm":
        assert any(Path(word.rstrip(".")).is_file() for word in str(error.value.fix).split())  # the job's log


def test_error_of_all_seeds_ends_the_run(jobs, undisturbed, tmp_path):
    out = tmp_path / "out"
    plan_faults(out, {13: ["refuse"]})
    with pytest.raises(MissingExtraError):
        jobs.run(out)
    jobs.run(out)
    assert_same(undisturbed, out)
    assert crashes_of(out) == []


@pytest.mark.parametrize(
    ("name", "module", "options"),
    [
        ("slurm", "submitit", {"partitoin": "x"}),
        ("slurm", "submitit", {"units_per_job": "0"}),
        ("slurm", "submitit", {"time": "2h"}),
        ("slurm", "submitit", {"cluster": "pbs"}),
        ("ray", "ray", {"cpus": "2"}),
        ("ray", "ray", {"num_cpus": "0"}),
        ("ray", "ray", {"gather": "perhaps"}),
    ],
)
def test_invalid_options_are_errors(name, module, options):
    pytest.importorskip(module)
    with pytest.raises(PlanError) as error:
        open_executor(name, PlanFolder(PLAN, Path()), 1, options)
    assert str(error.value.where).startswith("--executor-option")
