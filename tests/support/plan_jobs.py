"""Run the synthetic plan with the jobs of an executor."""

import os
import subprocess
import sys
import time
from pathlib import Path

import psutil
from plan_stages import PLAN

from robocas_ms3.plans.executors import open_executor
from robocas_ms3.plans.folder import PlanFolder
from robocas_ms3.plans.run import run_plan

RUNNER = Path(__file__).with_name("plan_runner.py")


class Jobs:
    """An executor with two jobs, called in this process or in a program."""

    def __init__(self, name, **options):
        self.name, self.options = name, options

    def run(self, out, **more):
        return run_plan(open_executor(self.name, PlanFolder(PLAN, out), 2, self.options | more))

    def start(self, out):
        """Start the program in a new process group; return its process."""
        words = [sys.executable, RUNNER, out, self.name, *(f"{name}={value}" for name, value in self.options.items())]
        env = {**os.environ, "PLAN_OUT": str(out)}
        return subprocess.Popen(words, env=env, stderr=subprocess.PIPE, text=True, start_new_session=True)

    def processes(self, out):
        """Return the worker processes of a program; with Ray, those of any plan."""
        found = []
        for process in psutil.process_iter(["cmdline", "environ"]):
            line = process.info["cmdline"] or [""]
            if self.name == "ray":
                found += [process] * " ".join(line).startswith(("ray::run_units", "ray::run_and_send_units"))
            elif (process.info["environ"] or {}).get("PLAN_OUT") == str(out) and not line[0].endswith("srun"):
                found += [process] * (str(RUNNER) not in line)
        return found


def wait_for(condition, seconds=60):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)
