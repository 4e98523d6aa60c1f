"""Plans on a real Slurm cluster, also when jobs, nodes and daemons are killed: the dataset of the local executor."""

import os
import signal
import subprocess
from pathlib import Path

import psutil
import pytest

pytest.importorskip("submitit", reason='plans on Slurm need submitit: pip install -e ".[slurm]"')

from plan_jobs import Jobs, wait_for
from plan_stages import assert_same, crashes_of, env_of_jobs, plan_faults

from robocas_ms3.core.errors import PlanError

CONF = Path("/etc/slurm/slurm.conf")
STARTS = Path(__file__).resolve().parents[2] / "scripts" / "slurm_here.sh"
IS_TEST_CLUSTER = CONF.is_file() and "Written by scripts/slurm_here.sh" in CONF.read_text() and os.getuid() == 0
JOBS = Jobs("slurm", time="10", mem_gb="1")


def slurm_answers():
    try:
        return subprocess.run(["sinfo", "--noheader"], capture_output=True, timeout=10, check=False).returncode == 0
    except (OSError, subprocess.TimeoutExpired):
        return False


NO_SLURM = "no Slurm answers here: scripts/slurm_here.sh starts one"
pytestmark = [pytest.mark.slow, pytest.mark.skipif(not slurm_answers(), reason=NO_SLURM)]


@pytest.fixture(autouse=True)
def jobs_know_the_made_up_episodes(monkeypatch):
    for name, value in env_of_jobs().items():
        monkeypatch.setenv(name, value)


class Running:
    """A run with a job that hangs in the middle of a work unit."""

    def __init__(self, out):
        self.out = out
        self.tries = plan_faults(out, {11: ["hang"]})
        self.process = JOBS.start(out)
        self.job()

    def job(self):
        """The process that is at the unit, and the id of its job."""
        wait_for(lambda: self.tries(11), 120)
        process = psutil.Process(self.tries(11)[-1]).parent()
        environment = process.environ()
        return process, f"{environment['SLURM_ARRAY_JOB_ID']}_{environment['SLURM_ARRAY_TASK_ID']}"

    def ends_well(self, undisturbed):
        assert self.process.wait(240) == 0, self.process.stderr.read()[-2000:]
        assert_same(undisturbed, self.out)
        assert crashes_of(self.out) == []  # no seed is blamed
        wait_for(lambda: not JOBS.processes(self.out), 30)


@pytest.fixture
def running(tmp_path):
    one = Running(tmp_path / "out")
    yield one
    one.process.kill()
    one.process.wait()


def output_of(*command):
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


def test_jobs_write_the_dataset_of_the_local_executor(undisturbed, tmp_path):
    JOBS.run(tmp_path / "out", units_per_job="2")
    assert_same(undisturbed, tmp_path / "out")


def test_rejection_by_sbatch_is_an_error(tmp_path):
    with pytest.raises(PlanError, match="partition"):
        JOBS.run(tmp_path / "out", partition="none_of_this_name")


def kill_processes(running):
    process, _ = running.job()
    for one in [*process.children(recursive=True), *process.parents()[:2], process]:
        if one.name() not in ("slurmstepd", "init", "systemd"):
            one.kill()


def make_room(running):
    if "PartitionName=first" not in output_of("scontrol", "show", "partition", "--oneliner"):
        pytest.skip("this Slurm has no partition that preempts: preemption is NOT tested")
    before = running.job()[0]
    output_of("sbatch", "--partition=first", "--exclusive", "--output=/dev/null", "--wrap", "sleep 1")
    before.wait(60)


def kill_slurmd(running):
    kill_all("slurmd")
    process, _ = running.job()
    process.kill()  # nobody says so to the controller before slurmd is back
    start_daemons()


def lose_the_node(running):
    kill_all("slurmd")
    kill_all("slurmstepd", with_children=True)
    start_daemons()


def kill_the_controller(running):
    kill_all("slurmctld")
    running.job()[0].kill()
    with pytest.raises(subprocess.TimeoutExpired):
        running.process.wait(8)  # it asks and gets no answer
    start_daemons()


def kill_the_command(running):
    running.process.kill()
    running.process.wait()
    left, _ = running.job()
    running.process = JOBS.start(running.out)
    left.wait(60)  # the next command cancels it


def interrupt_the_command(running):
    running.process.send_signal(signal.SIGINT)
    assert running.process.wait(10) != 0
    wait_for(lambda: not JOBS.processes(running.out), 30)
    wait_for(lambda: "robocas-out" not in output_of("squeue", "--noheader", "--format=%j"), 30)
    running.process = JOBS.start(running.out)


FAULTS = {
    "processes killed": kill_processes,
    "scancel": lambda running: output_of("scancel", running.job()[1]),
    "requeue": lambda running: output_of("scontrol", "requeue", running.job()[1]),
    "preempted": make_room,
    "command killed": kill_the_command,
    "Ctrl-C": interrupt_the_command,
}
OF_DAEMONS = {"slurmd": kill_slurmd, "node": lose_the_node, "slurmctld": kill_the_controller}


@pytest.mark.parametrize("fault", FAULTS.values(), ids=FAULTS)
def test_fault_loses_no_episode(running, undisturbed, fault):
    fault(running)
    running.ends_well(undisturbed)


@pytest.mark.skipif(not IS_TEST_CLUSTER, reason="this Slurm is not that of scripts/slurm_here.sh: its daemons live on")
@pytest.mark.parametrize("fault", OF_DAEMONS.values(), ids=OF_DAEMONS)
def test_fault_of_daemons_loses_no_episode(running, undisturbed, fault):
    fault(running)
    running.ends_well(undisturbed)
