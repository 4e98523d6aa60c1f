"""Units by jobs of Slurm: job arrays, which are looked after until each unit is done.

What came of a unit is read from its folder; a job's end alone says nothing. A job that ends early, whatever it died of,
costs its units nothing but time: they are handed in again and go on where their ledgers stop. That no two are ever at
one unit is seen to by `plans.claims`; that none is at one for a run that is over, by `plans.driver`.
"""

from __future__ import annotations

import math
import os
import threading
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from robocas_ms3.core.errors import PlanError
from robocas_ms3.core.sent_errors import SentError
from robocas_ms3.plans.driver import current_run
from robocas_ms3.plans.engines.slurm_job import UnitsJob
from robocas_ms3.plans.engines.slurm_options import read_options
from robocas_ms3.plans.engines.slurm_queue import error_of, open_queue, require_slurm
from robocas_ms3.plans.plan import Plan
from robocas_ms3.plans.units import DONE, Outcome, Unit, outcomes

_LOOK = 0.5  # s between two looks at the folders, at least
_LOOKS = 200.0  # folders a second that are looked at, at most
_AGAIN, _AGAIN_TIMES = 30.0, 20  # s between two tries to hand jobs in, where Slurm took some before
_JOIN = 0.5  # s
_LEFT = 60.0  # s that Slurm may take to cancel what is left


@dataclass
class _Asked:
    """A unit that was asked for.

    Attributes:
        unit: it.
        future: gets what came of it.
        seeds: that were done when it was handed in last.
        died: jobs in a row that died at the same seed of it.
    """

    unit: Unit
    future: Future[list[Outcome]] = field(default_factory=Future)
    seeds: int = 0
    died: int = 0


@dataclass
class _Array:
    """Jobs that were handed in together.

    Attributes:
        parallel: how many of them run at once.
        left: how many have not ended.
    """

    parallel: int
    left: int


@dataclass
class _Job:
    """A job of an array.

    Attributes:
        handle: submitit's.
        array: it belongs to.
        units: of it that are not done.
        over: when it was seen to have ended, or to have nothing left, s of this process's clock.
    """

    handle: Any
    array: _Array
    units: list[_Asked]
    over: float | None = None


class SlurmEngine:
    """A thread that hands units in and looks after them; see `engines.Engine`.

    Jobs do units for the run that the folder is of now, see `plans.driver`.

    Args:
        plan: of the units.
        out: the plan's folder, which all nodes see under the same path.
        jobs: that run at once.
        options: see `slurm_options`.
        stages: import path of what gives other stages than the plan's own, in each job.
    """

    lingers = 0.0  # a job claims its units

    def __init__(
        self, plan: Plan, out: Path, jobs: int, options: Mapping[str, str] | None = None, stages: str | None = None
    ) -> None:
        self._options = read_options(options or {})
        self._run = current_run(out)
        self._plan, self._out, self._at_once, self._stages = plan, out.absolute(), jobs, stages
        self._queue = open_queue(self._options, self._out, jobs, self._options.mem_gb or 2 * plan.limits.memory_gb)
        self._queue.cancel(seconds=_LEFT)  # what a killed run left there; later it would meet jobs of this one
        self.slots = jobs * self._options.units_per_job
        self._waiting: list[_Asked] = []
        self._jobs: list[_Job] = []
        self._refused, self._taken, self._not_before = 0, False, 0.0
        self._lock, self._closed = threading.Lock(), threading.Event()
        self._thread = threading.Thread(target=self._look_after, name="slurm", daemon=True)
        self._thread.start()

    @staticmethod
    def check(options: Mapping[str, str]) -> None:
        """See that Slurm is there and has such options; that submitit is, was seen when this was imported."""
        if read_options(options).executor == "slurm":
            require_slurm()

    def submit(self, unit: Unit) -> Future[list[Outcome]]:
        """Have a unit done."""
        asked = _Asked(unit)
        asked.future.set_running_or_notify_cancel()
        with self._lock:
            self._waiting.append(asked)
        return asked.future

    def close(self) -> None:
        """Cancel the jobs; those that Slurm is just taking leave by themselves."""
        self._closed.set()
        if self._run is not None:
            self._run.end()
        # what runs and has nothing left is about to end well
        self._queue.cancel(waiting_only=not any(job.units for job in list(self._jobs)))
        self._thread.join(_JOIN)

    def _look_after(self) -> None:
        while not self._closed.wait(self._pause()):
            try:
                self._hand_in()
                self._look()
            except Exception as error:  # whoever waits for a unit hears of it
                with self._lock:
                    asked = self._waiting + [one for job in self._jobs for one in job.units]
                for one in asked:
                    if not one.future.done():
                        one.future.set_exception(error)
                return

    def _pause(self) -> float:
        return max(_LOOK, sum(len(job.units) for job in self._jobs) / _LOOKS)

    def _hand_in(self) -> None:
        free = self._free()
        with self._lock:
            waiting = list(self._waiting)
        if free <= 0 or not waiting or time.monotonic() < self._not_before:
            return
        groups = self._grouped(waiting, free)[: self._queue.at_a_time]
        lease, run = self._options.lease, self._run.name if self._run is not None else None
        jobs = [
            UnitsJob(self._plan, self._out, tuple(one.unit for one in group), lease, self._stages, run)
            for group in groups
        ]
        try:
            handles = self._queue.submit(jobs, free)
        except Exception as error:
            self._refuse(error)
            return
        self._taken, self._refused = True, 0
        array = _Array(free, len(handles))
        handed = list(zip(handles, groups, strict=False))  # the first ones, if not all were taken
        for _, group in handed:
            for one in group:
                one.seeds = len(outcomes(self._folder(one)))
        with self._lock:
            self._jobs += [_Job(handle, array, group) for handle, group in handed]
            gone = {id(one) for _, group in handed for one in group}
            self._waiting = [one for one in self._waiting if id(one) not in gone]
        if self._closed.is_set():
            self._queue.cancel()

    def _free(self) -> int:
        """How many jobs more may run: arrays run none but their own beside each other."""
        arrays = {id(job.array): job.array for job in self._jobs}
        return self._at_once - sum(min(array.parallel, array.left) for array in arrays.values())

    def _grouped(self, waiting: list[_Asked], free: int) -> list[list[_Asked]]:
        """Units for each job: as many as may be, but none while others have nothing; one that killed a job is alone."""
        alone, others = [one for one in waiting if one.died], [one for one in waiting if not one.died]
        size = min(self._options.units_per_job, math.ceil(len(others) / free))
        return [[one] for one in alone] + [others[at : at + size] for at in range(0, len(others), max(1, size))]

    def _refuse(self, error: Exception) -> None:
        """Give up on what Slurm did not take, or try again later: what it took before was right.

        Raises:
            PlanError: it is given up.
        """
        self._refused += 1
        self._not_before = time.monotonic() + _AGAIN
        if not self._taken or self._refused > _AGAIN_TIMES:
            fix = "Look at --executor-option partition, account, qos, time and mem_gb."
            raise PlanError("Slurm takes no such jobs", where="sbatch", found=error, fix=fix) from error

    def _look(self) -> None:
        alive = self._queue.alive([job.handle for job in self._jobs])
        for job in list(self._jobs):
            job.units = [one for one in job.units if not self._finished(one)]
            ended = alive is not None and job.handle.job_id not in alive
            if job.units and not ended:
                job.over = None
                continue
            job.over = job.over or time.monotonic()
            late = time.monotonic() - job.over > self._queue.grace
            if late and not ended:
                self._queue.drop(job.handle)  # begun again by Slurm, though nothing was left to do
            if late or not job.units and ended:
                self._bury(job)

    def _finished(self, one: _Asked) -> bool:
        folder, seeds = self._folder(one), one.unit.seeds(self._plan)
        found: dict[int, Outcome] = {}
        with suppress(OSError):  # it is not there, or a file server has a bad moment
            if DONE in os.listdir(folder):  # which asks the server; whether the file exists may not
                found = outcomes(folder)
        if not all(seed in found for seed in seeds):
            return False
        one.future.set_result([found[seed] for seed in seeds])
        return True

    def _bury(self, job: _Job) -> None:
        """See to the units of a job that has ended."""
        error = error_of(job.handle) if job.units else None
        left, job.units = job.units, []
        if error is not None:
            self._fail(left, *error)
        elif left:
            self._count(left[0], job)  # it was at this one: they are done one after the other
        for path in () if left else (job.handle.paths.submitted_pickle, job.handle.paths.result_pickle):
            path.unlink(missing_ok=True)
        job.array.left -= 1
        with self._lock:
            self._jobs.remove(job)
            self._waiting = [one for one in left if not one.future.done()] + self._waiting

    def _count(self, one: _Asked, job: _Job) -> None:
        moved_on = len(outcomes(self._folder(one))) > one.seeds
        one.died = 1 if moved_on else one.died + 1
        if one.died >= self._options.tries:
            what, found = "the jobs of this unit die", f"{one.died} in a row, {self._queue.ending(job.handle)}"
            fix = f"See {job.handle.paths.stdout}; --executor-option mem_gb, time and tries may help."
            one.future.set_exception(PlanError(what, where=self._folder(one), found=found, fix=fix))

    def _fail(self, asked: Sequence[_Asked], unit: Unit, sent: SentError) -> None:
        for one in asked:
            if one.unit == unit:
                try:
                    sent.reraise()
                except BaseException as error:  # with where it came from
                    one.future.set_exception(error)

    def _folder(self, one: _Asked) -> Path:
        return one.unit.folder(self._plan, self._out)
