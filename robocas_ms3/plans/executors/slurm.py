"""Work units by jobs of Slurm: job arrays, submitted by submitit.

Whether a unit is done is read from its folder. Slurm requeues a job that is preempted, whose time is up or whose node
fails; a job that ends otherwise before its units are done is submitted again.
"""

from __future__ import annotations

import hashlib
import logging
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from typing import Annotated, Any, Literal

from pydantic import Field, create_model

from robocas_ms3.core.errors import PlanError, require_extra
from robocas_ms3.core.files import make_folder
from robocas_ms3.core.remote_errors import RemoteError
from robocas_ms3.core.strict_model import StrictModel
from robocas_ms3.plans.executors import Executor
from robocas_ms3.plans.folder import PlanFolder, WorkUnit
from robocas_ms3.plans.worker import WorkUnitWorker

require_extra("slurm", "plans on Slurm", "submitit")
submitit: Any = import_module("submitit")

LOGS = "slurm"
"""In the plan's folder: logs of the jobs, and what submitit writes."""
SBATCH_OPTIONS = (
    *("partition", "account", "qos", "constraint", "exclude", "nodelist", "gres", "gpus_per_node", "reservation"),
    *("licenses", "nice", "begin", "comment", "exclusive", "mem_per_cpu", "mail_type", "mail_user", "wckey"),
)
"""Options that are passed to sbatch as they are."""
_SBATCH_FIELDS: dict[str, Any] = {name: (str | None, None) for name in SBATCH_OPTIONS}
_ASK = 5.0  # s between two calls of squeue
_ANSWER = 60.0  # s that a command of Slurm may take
_CANCEL = 1.0  # s that Ctrl-C waits for scancel
_RETRY, _RETRIES = 30.0, 20  # s between two submissions, where Slurm took jobs before and refuses them now
_STUCK = ("JobHoldMaxRequeue", "launch_failed_requeued_held", "launch failed requeued held")
_log = logging.getLogger(__name__)


class _OwnOptions(StrictModel):
    cluster: Literal["slurm", "local"] = Field(default="slurm", description="local: jobs are processes here")
    units_per_job: Annotated[int, Field(ge=1)] = Field(default=1, description="one after the other")
    time: Annotated[int, Field(ge=1)] = Field(default=240, description="minutes of a job")
    requeues: Annotated[int, Field(ge=0)] = Field(default=3, description="of a job whose time is up")
    mem_gb: Annotated[float, Field(gt=0)] | None = Field(
        default=None, description="of a job; None: the limit of its two processes, 2 x limits.memory_gb of the plan"
    )
    cpus_per_task: Annotated[int, Field(ge=1)] = 1


class SlurmExecutor(Executor):
    """See `Executor`; the plan's folder has to be at the same path on all nodes."""

    options_type = create_model("SlurmOptions", __base__=_OwnOptions, **_SBATCH_FIELDS)

    def __init__(self, folder: PlanFolder, jobs: int = 1, options: Mapping[str, str] | None = None) -> None:
        super().__init__(folder, jobs, options)
        self._local = self.options.cluster == "local"
        if not self._local and submitit.SlurmExecutor.affinity() < 0:
            fix = "Run this where sbatch and srun are, or try --executor-option cluster=local."
            raise PlanError("there is no Slurm here", where="--executor slurm", expected="srun", fix=fix)

    def __enter__(self) -> SlurmExecutor:
        digest = hashlib.sha256(os.fsencode(self.folder.path.resolve())).hexdigest()[:8]
        self._name = f"robocas-{re.sub(r'[^A-Za-z0-9-]', '-', self.folder.path.name)}-{digest}"
        self._asked = 0.0
        self._alive: set[str] | None = None
        self._refused, self._not_before = 0, 0.0
        self._jobs: list[_Job] = []
        folder, requeues = make_folder(self.folder.path / LOGS), self.options.requeues
        if self._local:
            self._submitit = submitit.LocalExecutor(folder, max_num_timeout=requeues)
            self._submitit.update_parameters(timeout_min=self.options.time, stderr_to_stdout=True)
        else:
            self._submitit = submitit.SlurmExecutor(folder, max_num_timeout=requeues)
            self._submitit.update_parameters(**self._parameters())
        self._cancel(_ANSWER)  # the jobs of a run that was killed: two at a unit are harmless, but one is enough
        return self

    def _parameters(self) -> dict[str, Any]:
        options = self.options
        sbatch = options.model_dump(include=set(SBATCH_OPTIONS), exclude_none=True)
        mem_gb = options.mem_gb or 2 * self.folder.plan.limits.memory_gb
        return {
            "job_name": self._name,
            "time": options.time,
            "mem": None if options.mem_per_cpu else f"{round(mem_gb * 1024)}MB",
            "cpus_per_task": options.cpus_per_task,
            "srun_args": [f"--cpus-per-task={options.cpus_per_task}"],  # srun does not read that of sbatch since 22.05
            "stderr_to_stdout": True,
            "wckey": None,
            "array_parallelism": self.jobs,
            "additional_parameters": {"requeue": True, **{k: v == "true" or v for k, v in sbatch.items()}},
        }

    def submit(self, groups: Sequence[Sequence[WorkUnit]]) -> list[_Job]:
        if time.monotonic() < self._not_before:
            return []
        try:
            handles = self._submitit.submit_array([WorkUnitJob(self.folder, tuple(group)) for group in groups])
        except Exception as error:
            self._refused += 1
            self._not_before = time.monotonic() + _RETRY
            if not self._jobs or self._refused > _RETRIES:
                fix = "See --executor-option partition, account, qos, time and mem_gb."
                raise PlanError("Slurm refuses the jobs", where="sbatch", found=error, fix=fix) from error
            _log.warning("Slurm refuses jobs, and is asked again in %g s: %s", _RETRY, error)
            return []
        self._refused, self._asked = 0, 0.0
        jobs = [_Job(handle, None if self._local else self._has_left_queue) for handle in handles]
        self._jobs += jobs
        return jobs

    def _has_left_queue(self, job_id: str) -> bool:
        if time.monotonic() - self._asked > _ASK:
            self._alive = self._queue()
            self._asked = time.monotonic()
        return self._alive is not None and job_id not in self._alive

    def _queue(self) -> set[str] | None:
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

    def log_of(self, job: _Job) -> str:
        return f"{job.handle.paths.stdout}; --executor-option mem_gb and time may help"

    def __exit__(self, *error: object) -> None:
        self._cancel(_CANCEL)

    def _mine(self) -> list[str]:
        return [f"--name={self._name}", f"--user={os.getuid()}"]

    def _cancel(self, seconds: float) -> None:
        if self._local:
            for job in self._jobs:
                job.handle.cancel()
            until = time.monotonic() + seconds
            while time.monotonic() < until and not all(job.done() for job in self._jobs):
                time.sleep(0.05)
            return
        command, none = ["scancel", "--quiet", *self._mine()], subprocess.DEVNULL
        with suppress(OSError, subprocess.TimeoutExpired):  # a slow scancel continues by itself, despite Ctrl-C
            process = subprocess.Popen(command, stdin=none, stdout=none, stderr=none, start_new_session=True)
            if process.wait(seconds):
                _log.warning("jobs of this plan may be left: %s failed", " ".join(command))


@dataclass(frozen=True)
class _Job:
    """A job that was submitted; submitit would ask sacct about it, which not every cluster has."""

    handle: Any
    has_left_queue: Callable[[str], bool] | None

    def done(self) -> bool:
        return self.has_left_queue(self.handle.job_id) if self.has_left_queue else self.handle.done()

    def result(self) -> None:
        with suppress(OSError, EOFError):  # a job that was killed has no result
            outcome, error = submitit.core.utils.pickle_load(self.handle.paths.result_pickle)
            if outcome == "success" and error is not None:
                error.reraise()


@dataclass(frozen=True)
class WorkUnitJob:
    """What a job does, as submitit pickles it; a job that is requeued continues where the units stopped."""

    folder: PlanFolder
    units: tuple[WorkUnit, ...]

    def __call__(self) -> RemoteError | None:
        """Do the units; return an error that every seed would meet."""
        signal.signal(signal.SIGTERM, _exit)  # submitit would ignore it, and Slurm wait for 30 s
        worker = WorkUnitWorker(self.folder)
        # Slurm announces the end of the time to all processes of a job: block it in those of the worker, which inherit
        # the mask of this thread
        announcements = {signal.SIGUSR1, signal.SIGUSR2}
        thread = ThreadPoolExecutor(1, initializer=signal.pthread_sigmask, initargs=(signal.SIG_BLOCK, announcements))
        try:
            for unit in self.units:
                thread.submit(worker.do, unit).result()
        except Exception as error:
            return RemoteError.of(error, "a job")
        finally:
            worker.close()
        return None

    def checkpoint(self) -> Any:
        """Return what submitit runs once the time is up: the same job."""
        return submitit.helpers.DelayedSubmission(self)


def _exit(number: int, frame: object) -> None:
    signal.signal(number, signal.SIG_IGN)
    sys.exit(128 + number)


def _output(command: list[str]) -> str | None:
    """Return what a command of Slurm prints; None: it failed."""
    try:
        return subprocess.run(
            command, check=True, capture_output=True, text=True, timeout=_ANSWER, start_new_session=True
        ).stdout
    except (OSError, subprocess.SubprocessError):
        return None
