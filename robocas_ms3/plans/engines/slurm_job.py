"""What a job of Slurm does: some units, one after the other."""

from __future__ import annotations

import logging
import signal
import sys
from concurrent.futures import Future, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from robocas_ms3.core.extensions import load
from robocas_ms3.core.sent_errors import SentError
from robocas_ms3.plans.claims import claimed
from robocas_ms3.plans.driver import is_current
from robocas_ms3.plans.engines.local import LocalEngine
from robocas_ms3.plans.plan import Plan
from robocas_ms3.plans.units import CLAIMS, Outcome, Unit

FOLDER = CLAIMS.parent.name
"""In the plan's folder: logs of the jobs, what submitit keeps, and claims."""
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class UnitsJob:
    """The job, as it is pickled; begun again it goes on where its units stopped.

    Attributes:
        plan: of the units.
        out: the plan's folder.
        units: to be done.
        lease: s, of the claims on them.
        stages: import path of what gives the stages; None: the plan's own.
        run: name of the one that wants them; once the folder is of another one, nothing more is done.
    """

    plan: Plan
    out: Path
    units: tuple[Unit, ...]
    lease: float
    stages: str | None = None
    run: str | None = None

    def __call__(self) -> tuple[Unit, SentError] | None:
        """Do the units.

        Returns:
            None, or the unit whose error ends the plan.
        """
        signal.signal(signal.SIGTERM, _leave)  # submitit would let it pass, and Slurm wait for 30 s
        engine = LocalEngine(self.plan, self.out, 1, stages=load(self.stages)() if self.stages else None)
        try:
            for unit in self.units:
                if unit.is_done(self.plan, self.out):
                    continue
                if not self._is_wanted():
                    break
                error = self._do(engine, unit)
                if error is not None:
                    return unit, SentError.of(error, "a job")
        finally:
            engine.close()
        return None

    def _do(self, engine: LocalEngine, unit: Unit) -> BaseException | None:
        folder = unit.folder(self.plan, self.out)
        with claimed(self.out / CLAIMS / folder.parent.name / folder.name, self.lease):
            if not self._is_wanted():  # whoever begins another run now sees the claim; before, it saw none
                return None
            try:
                future = self._submit(engine, unit)
                wait([future])  # in its thread: what a signal raises here is no error of the unit
                return future.exception()
            except BaseException:
                engine.close()  # before the claim is given back
                raise

    def _is_wanted(self) -> bool:
        wanted = is_current(self.out, self.run)
        if not wanted:
            _log.warning("leaving: the run that wanted this job is over, or another one has begun in %s", self.out)
        return wanted

    def _submit(self, engine: LocalEngine, unit: Unit) -> Future[list[Outcome]]:
        """Begin in a thread, and so in processes, that don't hear what Slurm says before the time is up."""
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGUSR1, signal.SIGUSR2})
        try:
            return engine.submit(unit)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)

    def checkpoint(self) -> Any:
        """Say how submitit goes on with it once its time is up: in the same way."""
        from submitit.helpers import DelayedSubmission  # pyright: ignore[reportMissingImports]

        return DelayedSubmission(self)


def _leave(number: int, frame: object) -> None:
    signal.signal(number, signal.SIG_IGN)
    sys.exit(128 + number)
