"""Work units by jobs of Slurm: job arrays, submitted by submitit.

Whether a unit is done is read from its folder. Slurm requeues a job that is preempted, whose time is up or whose node
fails; a job that ends otherwise before its units are done is submitted again.
"""

from __future__ import annotations

import hashlib
import logging
import os
import re
import subprocess
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from threading import Event
from typing import Annotated, Any, Literal

from pydantic import Field

from robocas_ms3.core.errors import MissingExtraError, PlanError
from robocas_ms3.core.files import make_folder
from robocas_ms3.core.strict import StrictModel
from robocas_ms3.plans.executors import Setting, read_options
from robocas_ms3.plans.executors.slurm_job import UnitsJob
from robocas_ms3.plans.units import Unit

try:
    from submitit import LocalExecutor  # pyright: ignore[reportMissingImports]
    from submitit import SlurmExecutor as SubmititExecutor  # pyright: ignore[reportMissingImports]
    from submitit.core.utils import pickle_load  # pyright: ignore[reportMissingImports]
except ImportError as error:
    raise MissingExtraError(
        "plans on Slurm need submitit, which is not installed", fix='In the clone: pip install -e ".[slurm]"'
    ) from error

LOGS = "slurm"
"""In the plan's folder: logs of the jobs, and what submitit writes."""
SBATCH_OPTIONS = (
    *("partition", "account", "qos", "constraint", "exclude", "nodelist", "gres", "gpus_per_node", "reservation"),
    *("licenses", "nice", "begin", "comment", "exclusive", "mem_per_cpu", "mail_type", "mail_user", "wckey"),
)
"""Options that are passed to sbatch as they are."""
_ASK = 5.0  # s between two calls of squeue
_ANSWER = 60.0  # s that a command of Slurm may take
_CANCEL = 1.0  # s that Ctrl-C waits for scancel
_RETRY, _RETRIES = 30.0, 20  # s between two submissions, where Slurm took jobs before and refuses them now
_STUCK = ("JobHoldMaxRequeue", "launch_failed_requeued_held", "launch failed requeued held")
_log = logging.getLogger(__name__)


class SlurmOptions(StrictModel):
    """Values of ``--executor-option``, besides `SBATCH_OPTIONS`."""

    cluster: Literal["slurm", "local"] = Field(default="slurm", description="local: jobs are processes here")
    units_per_job: Annotated[int, Field(ge=1)] = Field(default=1, description="one after the other")
    time: Annotated[int, Field(ge=1)] = Field(default=240, description="minutes of a job")
    requeues: Annotated[int, Field(ge=0)] = Field(default=3, description="of a job whose time is up")
    mem_gb: Annotated[float, Field(gt=0)] | None = Field(
        default=None, description="of a job; None: the limit of its two processes, 2 x limits.memory_gb of the plan"
    )
    cpus_per_task: Annotated[int, Field(ge=1)] = 1


def read_slurm_options(options: Mapping[str, str]) -> tuple[SlurmOptions, dict[str, str]]:
    """Read the values of ``--executor-option``; return those of sbatch apart.

    Raises:
        PlanError: a name is unknown, or a value is invalid.
    """
    own = {name: value for name, value in options.items() if name not in SBATCH_OPTIONS}
    sbatch = {name: value for name, value in options.items() if name in SBATCH_OPTIONS}
    return read_options("slurm", SlurmOptions, own), sbatch


class SlurmExecutor:
    """See `executors.Executor`; the plan's folder has to be at the same path on all nodes."""

    def __init__(self, setting: Setting) -> None:
        self._setting = setting
        self._options, self._sbatch = read_slurm_options(setting.options)
        self.jobs, self.units_per_job = setting.jobs, self._options.units_per_job
        self._out = setting.out.absolute()
        self._local = self._options.cluster == "local"
        if not self._local:
            _check_slurm()
        folder = make_folder(self._out / LOGS)
        digest = hashlib.sha256(os.fsencode(self._out.resolve())).hexdigest()[:8]
        self._name = f"robocas-{re.sub(r'[^A-Za-z0-9-]', '-', self._out.name)}-{digest}"
        if self._local:
            self._submitit = LocalExecutor(folder, max_num_timeout=self._options.requeues)
            self._submitit.update_parameters(timeout_min=self._options.time, stderr_to_stdout=True)
        else:
            self._submitit = SubmititExecutor(folder, max_num_timeout=self._options.requeues)
            self._submitit.update_parameters(**self._parameters())
        self._asked, self._alive = 0.0, None
        self._submitted = False
        self._refused, self._not_before = 0, 0.0
        self._jobs: list[Any] = []
        self._cancel(_ANSWER)  # the jobs of a run that was killed: two at a unit are harmless, but one is enough

    @staticmethod
    def check(options: Mapping[str, str]) -> None:
        """Check the options, and that Slurm is on this machine."""
        if read_slurm_options(options)[0].cluster == "slurm":
            _check_slurm()

    def _parameters(self) -> dict[str, Any]:
        options = self._options
        mem_gb = options.mem_gb or 2 * self._setting.plan.limits.memory_gb
        return {
            "job_name": self._name,
            "time": options.time,
            "mem": None if "mem_per_cpu" in self._sbatch else f"{round(mem_gb * 1024)}MB",
            "cpus_per_task": options.cpus_per_task,
            "srun_args": [f"--cpus-per-task={options.cpus_per_task}"],  # srun does not read that of sbatch since 22.05
            "stderr_to_stdout": True,
            "wckey": None,
            "array_parallelism": self.jobs,
            "additional_parameters": {"requeue": True, **{k: v == "true" or v for k, v in self._sbatch.items()}},
        }

    def submit(self, groups: Sequence[Sequence[Unit]]) -> list[Any]:
        """Submit a job array."""
        if time.monotonic() < self._not_before:
            return []
        setting = self._setting
        jobs = [UnitsJob(setting.plan, self._out, tuple(group), setting.open_worker) for group in groups]
        try:
            handles = self._submitit.submit_array(jobs)
        except Exception as error:
            self._refused += 1
            self._not_before = time.monotonic() + _RETRY
            if not self._submitted or self._refused > _RETRIES:
                fix = "See --executor-option partition, account, qos, time and mem_gb."
                raise PlanError("Slurm refuses the jobs", where="sbatch", found=error, fix=fix) from error
            _log.warning("Slurm refuses jobs, and is asked again in %g s: %s", _RETRY, error)
            return []
        self._submitted, self._refused, self._asked = True, 0, 0.0
        self._jobs += handles
        return handles

    def ended(self, jobs: Sequence[Any], seconds: float) -> list[Any]:
        """Ask squeue, every few seconds; jobs of this machine are looked at."""
        Event().wait(seconds)
        if self._local:
            ended = [job for job in jobs if job.done()]
        else:
            if time.monotonic() - self._asked > _ASK:
                self._asked, self._alive = time.monotonic(), self._ask()
            alive = self._alive
            ended = [] if alive is None else [job for job in jobs if job.job_id not in alive]
        for job in ended:
            self._jobs.remove(job)
            with suppress(OSError, EOFError):  # a job that was killed has no result
                outcome, error = pickle_load(job.paths.result_pickle)
                if outcome == "success" and error is not None:
                    error.reraise()
        return ended

    def _ask(self) -> set[str] | None:
        """Return the ids of jobs that wait or run; None: Slurm does not answer."""
        answer = _output(["squeue", "--noheader", "--array", *self._mine(), "--format=%i|%r"])
        if answer is None:
            _log.warning("squeue does not answer, and is asked again; jobs continue")
            return None
        reasons = dict(line.strip().split("|", 1) for line in answer.splitlines())
        stuck = {job for job, reason in reasons.items() if reason in _STUCK}
        for job in stuck:  # Slurm would hold it forever
            _output(["scancel", job])
        return set(reasons) - stuck

    def log_of(self, job: Any) -> str:
        """Return the log of a job."""
        return f"{job.paths.stdout}; --executor-option mem_gb and time may help"

    def close(self) -> None:
        """Cancel the jobs."""
        self._cancel(_CANCEL)

    def _mine(self) -> list[str]:
        return [f"--name={self._name}", f"--user={os.getuid()}"]

    def _cancel(self, seconds: float) -> None:
        if self._local:
            for job in self._jobs:
                job.cancel()
            until = time.monotonic() + seconds
            while time.monotonic() < until and not all(job.done() for job in self._jobs):
                time.sleep(0.05)
            return
        command, none = ["scancel", "--quiet", *self._mine()], subprocess.DEVNULL
        with suppress(OSError, subprocess.TimeoutExpired):  # a slow scancel continues by itself, despite Ctrl-C
            process = subprocess.Popen(command, stdin=none, stdout=none, stderr=none, start_new_session=True)
            if process.wait(seconds):
                _log.warning("jobs of this plan may be left: %s failed", " ".join(command))


def _check_slurm() -> None:
    if SubmititExecutor.affinity() < 0:
        fix = "Run this where sbatch and srun are, or try --executor-option cluster=local."
        raise PlanError("there is no Slurm here", where="--executor slurm", expected="srun", fix=fix)


def _output(command: list[str]) -> str | None:
    """Return what a command of Slurm prints; None: it failed."""
    try:
        return subprocess.run(
            command, check=True, capture_output=True, text=True, timeout=_ANSWER, start_new_session=True
        ).stdout
    except (OSError, subprocess.SubprocessError):
        return None
