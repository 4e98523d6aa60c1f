"""Run work units as jobs of Slurm: job arrays, submitted by submitit.

The files in the folder of a work unit show whether the work unit is complete. Slurm requeues a job that is preempted,
exceeds its time limit or loses its node. A job that ends for another reason, with incomplete work units, is submitted
again.
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
"""Subfolder of the output folder with the logs of the jobs and the files of submitit."""
SBATCH_OPTIONS = (
    *("partition", "account", "qos", "constraint", "exclude", "nodelist", "gres", "gpus_per_node", "reservation"),
    *("licenses", "nice", "begin", "comment", "exclusive", "mem_per_cpu", "mail_type", "mail_user", "wckey"),
)
"""Options that are passed to sbatch unchanged."""
_SBATCH_FIELDS: dict[str, Any] = {name: (str | None, None) for name in SBATCH_OPTIONS}
_QUEUE_INTERVAL = 5.0  # s between two calls of squeue
_COMMAND_TIMEOUT = 60.0  # s that a command of Slurm may take
_CANCEL_TIMEOUT = 1.0  # s that Ctrl-C waits for scancel
_SUBMIT_INTERVAL, _MAX_REJECTIONS = 30.0, 20  # s between two submissions after a rejection
_HELD_REASONS = ("JobHoldMaxRequeue", "launch_failed_requeued_held", "launch failed requeued held")
_log = logging.getLogger(__name__)


class _SlurmOptions(StrictModel):
    cluster: Literal["slurm", "local"] = Field(default="slurm", description="local: jobs are processes of this machine")
    units_per_job: Annotated[int, Field(ge=1)] = Field(
        default=1, description="work units of a job, run one after the other"
    )
    time: Annotated[int, Field(ge=1)] = Field(default=240, description="time limit of a job, minutes")
    requeues: Annotated[int, Field(ge=0)] = Field(
        default=3, description="how often a job that exceeded its time limit is requeued"
    )
    mem_gb: Annotated[float, Field(gt=0)] | None = Field(
        default=None,
        description="memory of a job, GiB; default: 2 x limits.memory_gb of the plan, since a job has two processes",
    )
    cpus_per_task: Annotated[int, Field(ge=1)] = 1


class SlurmExecutor(Executor):
    """Run work units as jobs of Slurm; the output folder must have the same path on all nodes."""

    options_type = create_model("SlurmOptions", __base__=_SlurmOptions, **_SBATCH_FIELDS)

    def __init__(self, folder: PlanFolder, jobs: int = 1, options: Mapping[str, str] | None = None) -> None:
        super().__init__(folder, jobs, options)
        self._local = self.options.cluster == "local"
        if not self._local and submitit.SlurmExecutor.affinity() < 0:
            fix = "Run the command on a machine with sbatch and srun, or pass --executor-option cluster=local."
            raise PlanError("Slurm is not installed", where="--executor slurm", expected="the command srun", fix=fix)

    def __enter__(self) -> SlurmExecutor:
        digest = hashlib.sha256(os.fsencode(self.folder.path.resolve())).hexdigest()[:8]
        self._name = f"robocas-{re.sub(r'[^A-Za-z0-9-]', '-', self.folder.path.name)}-{digest}"
        self._queue_time = 0.0
        self._queued_jobs: set[str] | None = None
        self._rejections, self._not_before = 0, 0.0
        self._jobs: list[_Job] = []
        folder, requeues = make_folder(self.folder.path / LOGS), self.options.requeues
        if self._local:
            self._submitit = submitit.LocalExecutor(folder, max_num_timeout=requeues)
            self._submitit.update_parameters(timeout_min=self.options.time, stderr_to_stdout=True)
        else:
            self._submitit = submitit.SlurmExecutor(folder, max_num_timeout=requeues)
            self._submitit.update_parameters(**self._submitit_parameters())
        self._cancel(_COMMAND_TIMEOUT)  # jobs of an earlier run that was killed
        return self

    def _submitit_parameters(self) -> dict[str, Any]:
        options = self.options
        sbatch = options.model_dump(include=set(SBATCH_OPTIONS), exclude_none=True)
        mem_gb = options.mem_gb or 2 * self.folder.plan.limits.memory_gb
        return {
            "job_name": self._name,
            "time": options.time,
            "mem": None if options.mem_per_cpu else f"{round(mem_gb * 1024)}MB",
            "cpus_per_task": options.cpus_per_task,
            "srun_args": [f"--cpus-per-task={options.cpus_per_task}"],  # since 22.05 srun does not take it from sbatch
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
            self._rejections += 1
            self._not_before = time.monotonic() + _SUBMIT_INTERVAL
            if not self._jobs or self._rejections > _MAX_REJECTIONS:
                fix = "Check --executor-option partition, account, qos, time and mem_gb."
                raise PlanError("Slurm rejects the jobs", where="sbatch", found=error, fix=fix) from error
            _log.warning("Slurm rejects the jobs; they are submitted again in %g s: %s", _SUBMIT_INTERVAL, error)
            return []
        self._rejections, self._queue_time = 0, 0.0
        jobs = [_Job(handle, None if self._local else self._has_left_queue) for handle in handles]
        self._jobs += jobs
        return jobs

    def _has_left_queue(self, job_id: str) -> bool:
        if time.monotonic() - self._queue_time > _QUEUE_INTERVAL:
            self._queued_jobs = self._list_queued_jobs()
            self._queue_time = time.monotonic()
        return self._queued_jobs is not None and job_id not in self._queued_jobs

    def _list_queued_jobs(self) -> set[str] | None:
        """Return the ids of pending and running jobs, or None if Slurm does not answer."""
        answer = _run_command(["squeue", "--noheader", "--array", *self._job_filter(), "--format=%i|%r"])
        if answer is None:
            _log.warning("squeue does not answer and is called again; the jobs continue")
            return None
        reasons = dict(line.strip().split("|", 1) for line in answer.splitlines())
        held = {job for job, reason in reasons.items() if reason in _HELD_REASONS}
        for job in held:  # Slurm would hold it forever
            _run_command(["scancel", job])
        return set(reasons) - held

    def describe_log(self, job: _Job) -> str:
        return str(job.handle.paths.stdout)

    def __exit__(self, *error: object) -> None:
        self._cancel(_CANCEL_TIMEOUT)

    def _job_filter(self) -> list[str]:
        return [f"--name={self._name}", f"--user={os.getuid()}"]

    def _cancel(self, seconds: float) -> None:
        if self._local:
            for job in self._jobs:
                job.handle.cancel()
            until = time.monotonic() + seconds
            while time.monotonic() < until and not all(job.done() for job in self._jobs):
                time.sleep(0.05)
            return
        command, none = ["scancel", "--quiet", *self._job_filter()], subprocess.DEVNULL
        with suppress(OSError, subprocess.TimeoutExpired):  # a slow scancel continues after Ctrl-C
            process = subprocess.Popen(command, stdin=none, stdout=none, stderr=none, start_new_session=True)
            if process.wait(seconds):
                _log.warning("jobs of this plan may still run, because this command failed: %s", " ".join(command))


@dataclass(frozen=True)
class _Job:
    """A submitted job; squeue reports whether it has ended, because some clusters lack sacct, which submitit uses."""

    handle: Any
    has_left_queue: Callable[[str], bool] | None

    def done(self) -> bool:
        return self.has_left_queue(self.handle.job_id) if self.has_left_queue else self.handle.done()

    def result(self) -> None:
        with suppress(OSError, EOFError):  # a killed job has no result
            outcome, error = submitit.core.utils.pickle_load(self.handle.paths.result_pickle)
            if outcome == "success" and error is not None:
                error.reraise()


@dataclass(frozen=True)
class WorkUnitJob:
    """Function that a job runs, pickled by submitit; a requeued job continues its work units."""

    folder: PlanFolder
    units: tuple[WorkUnit, ...]

    def __call__(self) -> RemoteError | None:
        """Run the work units; return the error that affects all seeds, if any."""
        signal.signal(signal.SIGTERM, _exit_on_signal)  # submitit would ignore it, and Slurm would wait 30 s
        worker = WorkUnitWorker(self.folder)
        # Slurm signals the end of the time to all processes of a job: block the signals in the worker processes, which
        # inherit the mask of this thread
        time_signals = {signal.SIGUSR1, signal.SIGUSR2}
        thread = ThreadPoolExecutor(1, initializer=signal.pthread_sigmask, initargs=(signal.SIG_BLOCK, time_signals))
        try:
            for unit in self.units:
                thread.submit(worker.run, unit).result()
        except Exception as error:
            return RemoteError.from_error(error, "a job")
        finally:
            worker.close()
        return None

    def checkpoint(self) -> Any:
        """Return this job, so that submitit submits it again when its time limit is over."""
        return submitit.helpers.DelayedSubmission(self)


def _exit_on_signal(number: int, frame: object) -> None:
    signal.signal(number, signal.SIG_IGN)
    sys.exit(128 + number)


def _run_command(command: list[str]) -> str | None:
    """Run a command of Slurm; return its output, or None if it failed."""
    try:
        return subprocess.run(
            command, check=True, capture_output=True, text=True, timeout=_COMMAND_TIMEOUT, start_new_session=True
        ).stdout
    except (OSError, subprocess.SubprocessError):
        return None
