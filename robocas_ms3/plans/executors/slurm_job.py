"""A job of Slurm: does some work units, one after the other."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from robocas_ms3.core.remote_errors import RemoteError
from robocas_ms3.plans.plan import Plan
from robocas_ms3.plans.units import Unit
from robocas_ms3.plans.worker import UnitWorker


@dataclass(frozen=True)
class UnitsJob:
    """The job as submitit pickles it; a job that is requeued continues where the units stopped.

    Attributes:
        plan: the plan of the units.
        out: the output folder of the plan.
        units: to be done.
        open_worker: makes what does them.
    """

    plan: Plan
    out: Path
    units: tuple[Unit, ...]
    open_worker: Callable[[Plan, Path], UnitWorker]

    def __call__(self) -> RemoteError | None:
        """Do the units; return an error that every seed would meet."""
        signal.signal(signal.SIGTERM, _exit)  # submitit would ignore it, and Slurm wait for 30 s
        worker = self.open_worker(self.plan, self.out)
        # Slurm announces the end of the time to all processes of a job: block it in those of the worker, which inherit
        # the mask of this thread
        announcements = {signal.SIGUSR1, signal.SIGUSR2}
        thread = ThreadPoolExecutor(1, initializer=signal.pthread_sigmask, initargs=(signal.SIG_BLOCK, announcements))
        try:
            thread.submit(self._do, worker).result()
        except Exception as error:
            return RemoteError.of(error, "a job")
        finally:
            worker.close()
        return None

    def _do(self, worker: UnitWorker) -> None:
        for unit in self.units:
            worker.do(unit)

    def checkpoint(self) -> Any:
        """Return what submitit runs once the time is up: the same job."""
        from submitit.helpers import DelayedSubmission  # pyright: ignore[reportMissingImports]

        return DelayedSubmission(self)


def _exit(number: int, frame: object) -> None:
    signal.signal(number, signal.SIG_IGN)
    sys.exit(128 + number)
