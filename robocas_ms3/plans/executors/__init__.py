"""Executors have work units done: on this machine, by jobs of Slurm, by tasks of Ray."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, TypeVar

from robocas_ms3.core.errors import PlanError
from robocas_ms3.core.exits import deferred_interrupts
from robocas_ms3.core.extensions import load
from robocas_ms3.core.strict import StrictModel, parse
from robocas_ms3.plans.plan import Plan
from robocas_ms3.plans.units import Unit
from robocas_ms3.plans.worker import UnitWorker

EXECUTORS = {
    "local": "robocas_ms3.plans.executors.local:LocalExecutor",
    "slurm": "robocas_ms3.plans.executors.slurm:SlurmExecutor",
    "ray": "robocas_ms3.plans.executors.ray:RayExecutor",
}
"""Name -> class; what it needs is imported when it is chosen."""
Options = TypeVar("Options", bound=StrictModel)
_WAIT = 0.2  # s until a signal is handled


@dataclass(frozen=True)
class Setting:
    """What every executor gets.

    Attributes:
        plan: the plan of the units.
        out: the output folder of the plan.
        jobs: jobs that run at once.
        options: values of ``--executor-option``, by name.
        open_worker: makes what does the units; can be pickled.
    """

    plan: Plan
    out: Path
    jobs: int = 1
    options: Mapping[str, str] = field(default_factory=dict)
    open_worker: Callable[[Plan, Path], UnitWorker] = UnitWorker


class Executor(Protocol):
    """Has work units done by jobs.

    Attributes:
        jobs: jobs that run at once.
        units_per_job: units that a job does one after the other, at most.
    """

    jobs: int
    units_per_job: int

    def submit(self, groups: Sequence[Sequence[Unit]]) -> Sequence[Any]:
        """Submit a job for each group of units; return the jobs, or those of the first groups if not all fit."""
        ...

    def ended(self, jobs: Sequence[Any], seconds: float) -> Sequence[Any]:
        """Wait for a job to end, at most for some seconds; return those that have ended, whatever they ended of.

        Raises:
            RobocasError: an error of a job that every seed would meet.
        """
        ...

    def log_of(self, job: Any) -> str:
        """Return where a job that ended says why; may be empty."""
        ...

    def close(self) -> None:
        """Cancel all jobs, whatever they are at."""
        ...


def check_executor(name: str, options: Mapping[str, str]) -> None:
    """Check that an executor can be opened, before anything of an older run is deleted.

    Raises:
        PlanError: an option is unknown or invalid, or the executor can't be used on this machine.
        MissingExtraError: an extra is missing.
    """
    load(EXECUTORS[name]).check(options)


def open_executor(name: str, setting: Setting) -> Executor:
    """Open an executor; errors of `check_executor`."""
    return load(EXECUTORS[name])(setting)


def read_options(executor: str, model: type[Options], options: Mapping[str, str]) -> Options:
    """Read the values of ``--executor-option``.

    Raises:
        PlanError: a name is unknown, or a value is invalid.
    """
    values = {name: _value(text) for name, text in options.items()}
    about = f"not a valid option of the executor {executor}"
    return parse(model, values, PlanError, where="--executor-option", about=about)


def _value(text: str) -> Any:
    if text in {"yes", "true", "no", "false"}:
        return text in {"yes", "true"}
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


def ended_futures(futures: Sequence[Future[None]], seconds: float) -> list[Future[None]]:
    """Wait for a future, at most for some seconds; return those that have ended, after raising an error of one."""
    until = time.monotonic() + seconds
    done: set[Future[None]] = set()
    while not done and time.monotonic() < until:
        with deferred_interrupts():  # Ctrl-C inside could leave a lock of a future held
            done = wait(futures, _WAIT, FIRST_COMPLETED).done
    for future in done:
        future.result()
    return list(done)
