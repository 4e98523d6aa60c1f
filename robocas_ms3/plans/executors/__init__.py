"""Executors run work units: in processes of this machine, jobs of Slurm, or tasks of Ray."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

from pydantic import ValidationError

from robocas_ms3.core.errors import PlanError
from robocas_ms3.core.extensions import import_object
from robocas_ms3.core.strict_model import StrictModel, error_from_validation
from robocas_ms3.plans.folder import PlanFolder, WorkUnit
from robocas_ms3.plans.worker import WorkUnitWorker

EXECUTORS = {
    "local": "robocas_ms3.plans.executors:LocalExecutor",
    "slurm": "robocas_ms3.plans.executors.slurm:SlurmExecutor",
    "ray": "robocas_ms3.plans.executors.ray:RayExecutor",
}
"""Import path of each executor class by name; the module is imported when the executor is used."""


class Executor(ABC):
    """Base class of executors, which run jobs of one or more work units.

    An executor is a context manager. On exit it cancels its jobs.

    Args:
        folder: output folder of the plan.
        jobs: maximum number of jobs that run at the same time.
        options: values of ``--executor-option`` by name.

    Raises:
        PlanError: an option is unknown or invalid, or the executor is not available on this machine.
        MissingExtraError: an optional dependency of the executor is missing.
    """

    options_type: type[StrictModel] = StrictModel

    def __init__(self, folder: PlanFolder, jobs: int = 1, options: Mapping[str, str] | None = None) -> None:
        self.folder, self.jobs = replace(folder, path=folder.path.absolute()), jobs
        try:
            self.options: Any = self.options_type.model_validate_strings(dict(options or {}))
        except ValidationError as error:
            about = "invalid option of this executor"
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
        """Submit one job per group of work units.

        Returns:
            The jobs, in the order of the groups; fewer than groups if the cluster accepts no more jobs now. ``done()``
            of a job returns whether the job has ended. ``result()`` raises the error of an ended job that affects all
            seeds. It raises nothing for a job that was killed.
        """

    def describe_log(self, job: Any) -> str:
        """Return where to find the log of a job, for an error message."""
        return "the log of the job"


class ThreadExecutor(Executor):
    """An executor with one thread per job."""

    def __enter__(self) -> ThreadExecutor:
        self.threads = ThreadPoolExecutor(self.jobs, thread_name_prefix="plan")
        return self

    def submit(self, groups: Sequence[Sequence[WorkUnit]]) -> Sequence[Any]:
        return [self.threads.submit(self.run, group) for group in groups]

    @abstractmethod
    def run(self, units: Sequence[WorkUnit]) -> None:
        """Run the work units of a job in the calling thread."""


class LocalExecutor(ThreadExecutor):
    """Run work units on this machine, with two processes per job; there are no executor options."""

    def __enter__(self) -> LocalExecutor:
        self._workers = [WorkUnitWorker(self.folder) for _ in range(self.jobs)]
        self._idle = self._workers.copy()
        super().__enter__()
        return self

    def run(self, units: Sequence[WorkUnit]) -> None:
        worker = self._idle.pop()
        try:
            for unit in units:
                worker.run(unit)
        finally:
            self._idle.append(worker)

    def __exit__(self, *error: object) -> None:
        for worker in self._workers:
            worker.stop()
        self.threads.shutdown(cancel_futures=True)
        for worker in self._workers:
            worker.close()


def open_executor(name: str, folder: PlanFolder, jobs: int, options: Mapping[str, str]) -> Executor:
    """Create the executor with this name; raise the errors of `Executor`."""
    return import_object(EXECUTORS[name])(folder, jobs, options)
