"""The made-up plan by submitit's jobs, in this process or as a program: `python slurm_runs.py OUT OPTIONS_AS_JSON`."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import psutil
from plan_stages import PLAN

from robocas_ms3.plans.engines.slurm import SlurmEngine
from robocas_ms3.plans.run import run_plan

LOCAL = {"executor": "local", "lease": "6"}
SLURM = {"executor": "slurm", "lease": "6", "time": "10", "mem_gb": "1"}
NO_SLURM = "no Slurm answers here: scripts/slurm_here.sh starts one"


def slurm_answers():
    try:
        return subprocess.run(["sinfo", "--noheader"], capture_output=True, timeout=10, check=False).returncode == 0
    except (OSError, subprocess.TimeoutExpired):
        return False


def run(out, options, plan=PLAN, jobs=2, **more):
    def open_slurm(plan, out):
        return SlurmEngine(plan, out, jobs, options, stages="plan_stages:stages")

    return run_plan(plan, out, open_slurm, jobs=1, **more)


def start(out, options, **more):
    """The same by another process, which goes on where one stopped."""
    return subprocess.Popen([sys.executable, __file__, str(out), json.dumps(options)], text=True, **more)


def wait_for(what, seconds=120):
    until = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < until
        time.sleep(0.05)


def assert_done_once(out):
    """Nobody did again what another had done."""
    for folder in (out / "units").glob("*/*"):
        lines = [json.loads(line)["seed"] for line in (folder / "seeds.jsonl").read_text().splitlines()]
        assert sorted(set(lines)) == sorted(lines)


def processes_of(out):
    """Of the jobs that are at a plan: those that do units."""
    found = []
    for process in psutil.process_iter(["cmdline"]):
        line = process.info["cmdline"] or []
        if "submitit.core._submit" in line and str(out / "slurm") in line and not line[0].endswith("srun"):
            found.append(process)
    return found


def holds(process, out, seed):
    """Whether a job has the claim on the unit of a seed."""
    claims = out / "slurm" / "claims" / ("a" if seed >= 10 else "b")
    return any(path.read_text().split()[1:2] == [str(process.pid)] for path in claims.glob("00000.*"))


def stages_in_jobs(monkeypatch):
    path = [os.path.dirname(__file__), *filter(None, [os.environ.get("PYTHONPATH")])]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(path))


if __name__ == "__main__":
    run(Path(sys.argv[1]), json.loads(sys.argv[2]), resume=True)
