"""Plans by a real Slurm whose jobs, nodes and daemons are killed: the outcome is the local engine's."""

import os
import signal
import subprocess
from pathlib import Path

import psutil
import pytest

pytest.importorskip("submitit", reason='the engine slurm needs submitit: pip install -e ".[slurm]"')

from plan_stages import PLAN, assert_same, plan_faults
from slurm_runs import NO_SLURM, SLURM, assert_done_once, holds, run, slurm_answers, stages_in_jobs, start, wait_for
from slurm_runs import processes_of as processes_at

from robocas_ms3.core.errors import PlanError
from robocas_ms3.plans.run import run_plan
from robocas_ms3.plans.units import Unit, deaths

CONF = Path("/etc/slurm/slurm.conf")
STARTS = Path(__file__).resolve().parents[2] / "scripts" / "slurm_here.sh"
OURS = CONF.is_file() and "Written by scripts/slurm_here.sh" in CONF.read_text() and os.getuid() == 0
pytestmark = [pytest.mark.slow, pytest.mark.skipif(not slurm_answers(), reason=NO_SLURM)]
ours = pytest.mark.skipif(not OURS, reason="this Slurm is not that of scripts/slurm_here.sh: its daemons live on")


@pytest.fixture(autouse=True)
def jobs_know_the_stages(monkeypatch):
    stages_in_jobs(monkeypatch)


class Running:
    """A run, one job of which hangs in the middle of a unit."""

    def __init__(self, out, options=SLURM):
        self.out, self.options = out, options
        plan_faults(out, {11: ["hang"]})
        self.process = start(out, options, stderr=subprocess.PIPE)
        wait_for(out.with_name("out-tries-11").exists)

    def job(self):
        """The process that is at the unit, and the id of its job."""
        (process,) = [one for one in processes_at(self.out) if holds(one, self.out, 11)]
        environment = process.environ()
        return process, f"{environment['SLURM_ARRAY_JOB_ID']}_{environment['SLURM_ARRAY_TASK_ID']}"

    def ends_well(self, undisturbed):
        assert self.process.wait(240) == 0, self.process.stderr.read()[-2000:]
        assert_same(undisturbed, self.out)
        assert_done_once(self.out)
        assert deaths(Unit(0, 0).folder(PLAN, self.out)).read() == []  # no seed is blamed
        wait_for(lambda: not processes_at(self.out), 30)


@pytest.fixture
def running(tmp_path):
    one = Running(tmp_path / "out")
    yield one
    one.process.kill()
    one.process.wait()


def say(*command):
    return subprocess.run(command, check=True, capture_output=True, text=True, timeout=60).stdout


def kill_all(name, *, with_children=False):
    for daemon in psutil.process_iter(["name"]):
        if daemon.info["name"] == name:
            doomed = [*(daemon.children(recursive=True) if with_children else ()), daemon]
            for process in doomed:
                process.kill()
            psutil.wait_procs(doomed, 10)  # slurm_here.sh would find them running


def start_daemons():
    subprocess.run(["bash", STARTS], check=True, capture_output=True, timeout=120)


def test_what_sbatch_refuses_is_said(tmp_path):
    with pytest.raises(PlanError, match="Slurm takes no such jobs.*partition"):
        run(tmp_path / "out", {"partition": "none_of_this_name"})


def test_a_job_whose_processes_are_killed_costs_nothing(running, undisturbed):
    process, _ = running.job()
    for one in [*process.children(recursive=True), *process.parents()[:2], process]:
        if one.name() not in ("slurmstepd", "init", "systemd"):
            one.kill()
    running.ends_well(undisturbed)


def test_a_job_that_is_cancelled_by_hand_costs_nothing(running, undisturbed):
    say("scancel", running.job()[1])
    running.ends_well(undisturbed)


def test_a_requeued_job_goes_on(running, undisturbed):
    say("scontrol", "requeue", running.job()[1])
    running.ends_well(undisturbed)


def test_a_job_that_makes_room_for_another_goes_on(running, undisturbed):
    partitions = say("scontrol", "show", "partition", "--oneliner")
    if "PartitionName=first" not in partitions:
        pytest.skip("this Slurm has no partition that preempts: preemption is NOT tested")
    before = running.job()[0]
    say("sbatch", "--partition=first", "--exclusive", "--output=/dev/null", "--wrap", "sleep 1")
    before.wait(60)
    running.ends_well(undisturbed)


@ours
def test_while_slurmd_is_down_a_job_goes_on(running, undisturbed):
    kill_all("slurmd")
    process, _ = running.job()
    process.kill()  # nobody says so to the controller before slurmd is back
    start_daemons()
    running.ends_well(undisturbed)


@ours
def test_a_node_that_is_lost_costs_nothing(running, undisturbed):
    kill_all("slurmd")
    kill_all("slurmstepd", with_children=True)
    start_daemons()
    running.ends_well(undisturbed)


@ours
def test_without_a_controller_for_a_while_nothing_is_lost(running, undisturbed):
    kill_all("slurmctld")
    running.job()[0].kill()
    with pytest.raises(subprocess.TimeoutExpired):
        running.process.wait(8)  # it asks and gets no answer
    start_daemons()
    running.ends_well(undisturbed)


def test_a_run_that_is_killed_leaves_jobs_that_the_next_ends(running, undisturbed):
    running.process.kill()
    running.process.wait()
    left, _ = running.job()
    running.process = start(running.out, running.options, stderr=subprocess.PIPE)
    left.wait(60)
    running.ends_well(undisturbed)


def test_jobs_that_wait_when_their_run_is_killed_do_nothing_once_they_start(tmp_path):
    out = tmp_path / "out"
    process = start(out, SLURM | {"begin": "now+8"}, stderr=subprocess.DEVNULL)
    wait_for(lambda: "robocas-out" in say("squeue", "--noheader", "--format=%j"))
    process.kill()
    process.wait()
    with pytest.raises(ZeroDivisionError):
        run_plan(PLAN, out, lambda *_: 1 / 0, resume=True)  # another engine, which does not know of the queue
    wait_for(lambda: "robocas-out" not in say("squeue", "--noheader", "--format=%j"))
    logs = [path.read_text() for path in (out / "slurm").glob("*_log.out")]
    assert logs
    assert all("leaving: the run that wanted this job is over" in log for log in logs)
    assert not list((out / "units").glob("*/*"))


def test_ctrl_c_cancels_all_jobs(running, undisturbed):
    running.process.send_signal(signal.SIGINT)
    assert running.process.wait(10) != 0
    wait_for(lambda: not processes_at(running.out), 30)
    wait_for(lambda: "robocas-out" not in say("squeue", "--noheader", "--format=%j"), 30)
    running.process = start(running.out, running.options, stderr=subprocess.PIPE)
    running.ends_well(undisturbed)
