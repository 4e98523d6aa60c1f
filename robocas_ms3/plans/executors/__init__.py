"""Executors run work units: in processes of this machine, in jobs of Slurm, in tasks of Ray."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

from pydantic import ValidationError

from robocas_ms3.core.errors import PlanError
from robocas_ms3.core.extensions import load_object
from robocas_ms3.core.strict_model import StrictModel, error_from_validation
from robocas_ms3.plans.folder import PlanFolder, WorkUnit
from robocas_ms3.plans.worker import WorkUnitWorker

EXECUTORS = {
    "local": "robocas_ms3.plans.executors:LocalExecutor",
    "slurm": "robocas_ms3.plans.executors.slurm:SlurmExecutor",
    "ray": "robocas_ms3.plans.executors.ray:RayExecutor",
}
"""Name -> class; its module is imported when it is chosen."""


class Executor(ABC):
    """Runs jobs, each of which does some work units; a context manager, which cancels them.

    Args:
        folder: of the plan of the units.
        jobs: maximum number of jobs at once.
        options: values of ``--executor-option``, by name.

    Raises:
        PlanError: an option is unknown or invalid, or the executor can't be used on this machine.
        MissingExtraError: an extra is missing.
    """

    options_type: type[StrictModel] = StrictModel

    def __init__(self, folder: PlanFolder, jobs: int = 1, options: Mapping[str, str] | None = None) -> None:
        self.folder, self.jobs = replace(folder, path=folder.path.absolute()), jobs
        try:
            self.options: Any = self.options_type.model_validate_strings(dict(options or {}))
        except ValidationError as error:
            about = "not a valid option of this executor"
            raise error_from_validation(
                error, self.options_type, PlanError, where="--executor-option", about=about
            ) from error
        self.units_per_job: int = getattr(self.options, "units_per_job", 1)

    @abstractmethod
    def __enter__(self) -> Any: ...

    @abstractmethod
    def __exit__(self, *error: object) -> None: ...

    @abstractmethod
    def submit(self, groups: Sequence[Sequence[WorkUnit]]) -> Sequence[Any]:
        """Submit a job for each group of units; return the jobs, or those of the first groups if not all fit.

        The ``done()`` of a job returns whether it has ended, its ``result()`` raises an error that every seed would
        meet. A job that was killed has no error.
        """

    def log_of(self, job: Any) -> str:
        """Return where a job that was killed may say why."""
        return "the log of the job"


class ThreadExecutor(Executor):
    """Waits for each job in a thread."""

    def __enter__(self) -> ThreadExecutor:
        self.threads = ThreadPoolExecutor(self.jobs, thread_name_prefix="plan")
        return self

    def submit(self, groups: Sequence[Sequence[WorkUnit]]) -> Sequence[Any]:
        return [self.threads.submit(self.run, group) for group in groups]

    @abstractmethod
    def run(self, units: Sequence[WorkUnit]) -> None:
        """Do some units, as a job."""


class LocalExecutor(ThreadExecutor):
    """Work units on this machine: a thread per job, each with two processes. It has no options."""

    def __enter__(self) -> LocalExecutor:
        self._workers = [WorkUnitWorker(self.folder) for _ in range(self.jobs)]
        self._idle = self._workers.copy()
        super().__enter__()
        return self

    def run(self, units: Sequence[WorkUnit]) -> None:
        worker = self._idle.pop()
        try:
            for unit in units:
                worker.do(unit)
        finally:
            self._idle.append(worker)

    def __exit__(self, *error: object) -> None:
        for worker in self._workers:
            worker.stop()
        self.threads.shutdown(cancel_futures=True)
        for worker in self._workers:
            worker.close()


def open_executor(name: str, folder: PlanFolder, jobs: int, options: Mapping[str, str]) -> Executor:
    """Return an executor of this name; raises as `Executor` does."""
    return load_object(EXECUTORS[name])(folder, jobs, options)
