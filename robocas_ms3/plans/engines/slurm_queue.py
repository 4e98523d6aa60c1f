"""Where jobs are handed in and looked after, by submitit: Slurm's queue, or processes of this machine in its place."""

from __future__ import annotations

import hashlib
import logging
import os
import re
import subprocess
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol

from robocas_ms3.core.errors import MissingExtraError, PlanError
from robocas_ms3.core.files import make_folder
from robocas_ms3.core.sent_errors import SentError
from robocas_ms3.plans.engines.slurm_job import FOLDER, UnitsJob
from robocas_ms3.plans.engines.slurm_options import SlurmOptions
from robocas_ms3.plans.units import Unit

try:
    from submitit import LocalExecutor, SlurmExecutor  # pyright: ignore[reportMissingImports]
    from submitit.core.utils import pickle_load  # pyright: ignore[reportMissingImports]
except ImportError as error:
    raise MissingExtraError(
        "plans on Slurm need submitit, which is not installed", fix='In the clone: pip install -e ".[slurm]"'
    ) from error

_ASK = 5.0  # s between two questions to Slurm
_ANSWER = 60.0  # s that one may take
AT_ONCE = 1.0
"""Seconds for a question that must not be waited for."""
_log = logging.getLogger(__name__)
_STUCK = ("JobHoldMaxRequeue", "launch_failed_requeued_held", "launch failed requeued held")


class Queue(Protocol):
    """Jobs by their id."""

    grace: float
    """Seconds until a file that a job wrote last is seen here."""
    at_a_time: int
    """Jobs that may be handed in at once, though not all of them run at once."""

    def submit(self, jobs: Sequence[UnitsJob], parallel: int) -> list[Any]:
        """Hand jobs in, ``parallel`` of which run at once; gives submitit's jobs."""
        ...

    def alive(self, jobs: Sequence[Any]) -> set[str] | None:
        """Ids of those that wait or run; None: not known just now."""
        ...

    def ending(self, job: Any) -> str:
        """In a word, how a job ended."""
        ...

    def drop(self, job: Any) -> None:
        """End a job."""
        ...

    def cancel(self, *, waiting_only: bool = False, seconds: float = AT_ONCE) -> None:
        """End all jobs of the plan, those of a killed run too, or those that do not run yet; wait for so long."""
        ...


class SlurmQueue:
    """Slurm itself. It is asked by squeue, as not all clusters keep the accounts that submitit asks for."""

    grace, at_a_time = 10.0, 1000

    def __init__(self, options: SlurmOptions, out: Path, mem_gb: float) -> None:
        require_slurm()
        self._executor = SlurmExecutor(make_folder(out / FOLDER), max_num_timeout=options.tries)
        digest = hashlib.sha256(os.fsencode(out.resolve())).hexdigest()[:8]
        self._mine = [f"--name=robocas-{re.sub(r'[^A-Za-z0-9-]', '-', out.name)}-{digest}", f"--user={os.getuid()}"]
        self._parameters: dict[str, Any] = {
            "job_name": self._mine[0].partition("=")[2],
            "time": options.time,
            "mem": None if "mem_per_cpu" in options.sbatch else f"{round(mem_gb * 1024)}MB",
            "cpus_per_task": options.cpus_per_task,
            "srun_args": [f"--cpus-per-task={options.cpus_per_task}"],  # srun stopped asking sbatch for it in 22.05
            "stderr_to_stdout": True,
            "wckey": None,
            "additional_parameters": {"requeue": True, **{k: v == "true" or v for k, v in options.sbatch.items()}},
        }
        self._asked, self._alive, self._hopeless = 0.0, None, set[str]()
        self._silent = False

    def submit(self, jobs: Sequence[UnitsJob], parallel: int) -> list[Any]:
        """Hand in a job array."""
        self._executor.update_parameters(**self._parameters, array_parallelism=parallel)
        handed = self._executor.submit_array(jobs)
        self._asked = 0.0
        return handed

    def alive(self, jobs: Sequence[Any]) -> set[str] | None:
        """Ask every few seconds."""
        if time.monotonic() - self._asked > _ASK:
            self._asked = time.monotonic()
            self._alive = self._ask()
        return self._alive

    def _ask(self) -> set[str] | None:
        said = _say(["squeue", "--noheader", "--array", *self._mine, "--format=%i|%r"])
        if said is None:
            if not self._silent:
                _log.warning("squeue does not answer; jobs go on, and it is asked again every %g s", _ASK)
            self._silent = True
            return None
        self._silent = False
        reasons = dict(line.strip().split("|", 1) for line in said.splitlines())
        stuck = {job for job, reason in reasons.items() if reason in _STUCK}
        for job in stuck:  # Slurm would keep it forever
            _say(["scancel", job])
        self._hopeless |= stuck
        return set(reasons) - stuck

    def ending(self, job: Any) -> str:
        """Ask for its state, which Slurm knows for some minutes."""
        if job.job_id in self._hopeless:
            return "held after it could not be started"
        said = _say(["squeue", "--noheader", "--states=all", f"--jobs={job.job_id}", "--format=%T"])
        return (said or "").strip().partition("\n")[0] or "gone"

    def drop(self, job: Any) -> None:
        """By its id."""
        _say(["scancel", "--quiet", job.job_id])

    def cancel(self, *, waiting_only: bool = False, seconds: float = AT_ONCE) -> None:
        """By their name; a slow scancel goes on by itself."""
        command = ["scancel", "--quiet", *self._mine, *(["--state=PENDING"] if waiting_only else [])]
        with suppress(OSError, subprocess.TimeoutExpired):
            if _begin(command).wait(seconds):
                _log.warning("jobs of this plan may be left: %s failed", " ".join(command))


class LocalQueue:
    """Processes of this machine; all that are handed in run."""

    grace = 1.0

    def __init__(self, options: SlurmOptions, out: Path, jobs: int) -> None:
        self.at_a_time = jobs
        self._executor = LocalExecutor(make_folder(out / FOLDER), max_num_timeout=options.tries)
        self._executor.update_parameters(timeout_min=options.time, stderr_to_stdout=True)
        self._jobs: list[Any] = []

    def submit(self, jobs: Sequence[UnitsJob], parallel: int) -> list[Any]:
        """Start them."""
        handed = self._executor.submit_array(jobs[:parallel])
        self._jobs += handed
        return handed

    def alive(self, jobs: Sequence[Any]) -> set[str] | None:
        """Look."""
        self._jobs = [job for job in self._jobs if not job.done()]
        return {job.job_id for job in self._jobs}

    def ending(self, job: Any) -> str:
        """Say so."""
        return str(job.state)

    def drop(self, job: Any) -> None:
        """Interrupt it."""
        job.cancel()

    def cancel(self, *, waiting_only: bool = False, seconds: float = AT_ONCE) -> None:
        """Interrupt them: they kill what does not leave within a second."""
        if waiting_only:
            return
        for job in self._jobs:
            job.cancel()
        until = time.monotonic() + seconds
        while time.monotonic() < until and self.alive(()):
            time.sleep(0.05)


def require_slurm() -> None:
    """See that Slurm's commands are here.

    Raises:
        PlanError: they aren't.
    """
    if SlurmExecutor.affinity() < 0:
        fix = "Run this where sbatch and srun are, or try --executor-option executor=local."
        raise PlanError("there is no Slurm here", where="--on slurm", expected="srun", fix=fix)


def open_queue(options: SlurmOptions, out: Path, jobs: int, mem_gb: float) -> Queue:
    """Open one.

    Args:
        options: say which.
        out: the plan's folder.
        jobs: that run at once.
        mem_gb: of a job.

    Raises:
        PlanError: there is no Slurm.
    """
    return LocalQueue(options, out, jobs) if options.executor == "local" else SlurmQueue(options, out, mem_gb)


def error_of(job: Any) -> tuple[Unit, SentError] | None:
    """The unit whose error ended a job, if that could still say so."""
    with suppress(OSError, EOFError):
        outcome, said = pickle_load(job.paths.result_pickle)
        return said if outcome == "success" else None
    return None


def _begin(command: list[str]) -> subprocess.Popen[bytes]:
    """Begin a command of Slurm's that Ctrl-C does not reach."""
    nothing = subprocess.DEVNULL
    return subprocess.Popen(command, stdin=nothing, stdout=nothing, stderr=nothing, start_new_session=True)


def _say(command: list[str]) -> str | None:
    """What a command of Slurm's prints; None: it failed."""
    try:
        return subprocess.run(
            command, check=True, capture_output=True, text=True, timeout=_ANSWER, start_new_session=True
        ).stdout
    except (OSError, subprocess.SubprocessError):
        return None
