"""The made-up plan by submitit's jobs, in this process or as a program: `python slurm_runs.py OUT OPTIONS_AS_JSON`."""

import json
import subprocess
import sys
import time
from pathlib import Path

import psutil
from plan_stages import PLAN, open_worker

from robocas_ms3.plans.executors.slurm import SlurmExecutor
from robocas_ms3.plans.run import run_plan

LOCAL = {"cluster": "local"}
SLURM = {"cluster": "slurm", "time": "10", "mem_gb": "1"}
NO_SLURM = "no Slurm answers here: scripts/slurm_here.sh starts one"


def slurm_answers():
    try:
        return subprocess.run(["sinfo", "--noheader"], capture_output=True, timeout=10, check=False).returncode == 0
    except (OSError, subprocess.TimeoutExpired):
        return False


def run(out, options, jobs=2):
    return run_plan(SlurmExecutor(PLAN, out, jobs, options, open_worker))


def start(out, options, **more):
    """The same by another process."""
    return subprocess.Popen([sys.executable, __file__, str(out), json.dumps(options)], text=True, **more)


def wait_for(what, seconds=120):
    until = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < until
        time.sleep(0.05)


def processes_of(out):
    """Of the jobs that are at a plan: those that do units."""
    found = []
    for process in psutil.process_iter(["cmdline"]):
        line = process.info["cmdline"] or []
        if "submitit.core._submit" in line and str(out / "slurm") in line and not line[0].endswith("srun"):
            found.append(process)
    return found


def job_at(out, seed):
    """The process of the job that hangs at a seed, once it does."""
    tries = out.with_name(f"{out.name}-tries-{seed}")
    wait_for(lambda: tries.exists() and tries.read_text().endswith(" "))
    return psutil.Process(int(tries.read_text().split()[-1])).parent()


if __name__ == "__main__":
    run(Path(sys.argv[1]), json.loads(sys.argv[2]))
