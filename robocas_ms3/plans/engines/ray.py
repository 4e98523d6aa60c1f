"""Units on a cluster of Ray: an actor a job, on whatever node has room; what dies is replaced."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from concurrent.futures import CancelledError, Future
from dataclasses import dataclass, field
from pathlib import Path
from queue import Empty, PriorityQueue
from typing import Any

from robocas_ms3.core.errors import PlanError
from robocas_ms3.core.sent_errors import SentError
from robocas_ms3.demos.recordings.versions import versions
from robocas_ms3.plans.engines.pieces import Arriving
from robocas_ms3.plans.engines.ray_actor import RaySlot, Terms
from robocas_ms3.plans.engines.ray_cluster import connect, read_options, require_ray
from robocas_ms3.plans.plan import Plan
from robocas_ms3.plans.slot import Stages
from robocas_ms3.plans.units import DEATHS, LEDGER, Outcome, Unit, outcomes

TRIES = 3
"""How often a unit is begun again where it has lost its actor at the same seed, counting the first time."""
LEASE = 30.0
"""Seconds that an actor goes on without hearing of the driver."""
ENDING = 5.0
"""Seconds that an actor's processes may take to end, once it has none."""
_BEAT = 2.0  # s between two messages to an actor
_LOOK = 0.5  # s
_AHEAD = 4  # pieces of files that wait in the object store, of each actor
_CLOSING = 1.2  # s that actors get to tidy up
_JOINING = 3.0  # s, of a thread that may hang at a disk


@dataclass(order=True)
class _Job:
    unit: Unit
    future: Future[list[Outcome]] = field(default_factory=Future, compare=False)
    lost: int = field(default=0, compare=False)
    seeds: int = field(default=-1, compare=False)  # that were done when it was lost


class _Actor:
    """One actor, as the driver sees it."""

    def __init__(self, ray: Any, handle: Any) -> None:
        self._ray, self.handle, self._lock = ray, handle, threading.Lock()
        self.answered = time.monotonic()
        self.gone = self.ready = False
        self._known: float | None = None
        self._answer = handle.renew.remote(None)

    def beat(self) -> None:
        """Renew its lease if it answered to what it was told before."""
        with self._lock:
            if self.gone or not self._ray.wait([self._answer], timeout=0)[0]:
                return
            try:
                self._known = self._ray.get(self._answer)
            except self._ray.exceptions.RayError:
                self.gone = True
                return
            self.answered = time.monotonic()  # later than the actor did: its lease ends before LEASE from now
            self._answer = self.handle.renew.remote(self._known)

    def end(self) -> None:
        """Have it ended, which can't be seen where its node is cut off; its lease is not renewed any more."""
        with self._lock:
            self.gone = True
        self._ray.kill(self.handle)


class RayEngine:
    """Threads that each look after an actor; see `engines.Engine`.

    An actor or node that dies costs the seed that was under way: its unit is done again elsewhere, once it is sure
    that nobody is at it any more (`ray_actor`). Where files are gathered, the driver alone writes into its folder.
    """

    def __init__(
        self, plan: Plan, out: Path, jobs: int, options: Mapping[str, str] | None = None, stages: Stages | None = None
    ) -> None:
        self.slots = jobs
        self.lingers = 0.0
        self._options, self._plan, self._out = read_options(options or {}), plan, out
        self._ray = require_ray()
        self._lost = (
            self._ray.exceptions.RayActorError,
            self._ray.exceptions.ObjectLostError,
            self._ray.exceptions.OutOfMemoryError,
        )
        shared = None if self._options.gather else out.absolute()
        if shared is not None:
            self.lingers = LEASE + ENDING
        self._terms = Terms(plan, shared, LEASE, versions(), stages)
        self._disconnects = connect(self._options, jobs)
        self._remote = self._ray.remote(
            num_cpus=self._options.num_cpus, num_gpus=self._options.num_gpus, max_concurrency=4, max_restarts=0
        )(RaySlot)
        self._actors: set[_Actor] = set()
        self._lock, self._closed = threading.Lock(), threading.Event()
        self._jobs: PriorityQueue[_Job] = PriorityQueue()
        self._threads = [
            threading.Thread(target=target, daemon=True, name="ray") for target in [self._beat, *[self._serve] * jobs]
        ]
        for thread in self._threads:
            thread.start()

    @staticmethod
    def check(options: Mapping[str, str]) -> None:
        """See that Ray is there, and has such options."""
        require_ray()
        read_options(options)

    def submit(self, unit: Unit) -> Future[list[Outcome]]:
        """Have a unit done."""
        job = _Job(unit)
        self._jobs.put(job)
        return job.future

    def _beat(self) -> None:
        while not self._closed.wait(_BEAT):
            with self._lock:
                actors = list(self._actors)
            for actor in actors:
                actor.beat()

    def _serve(self) -> None:
        failed = 0
        while not self._closed.is_set():
            with self._lock:
                if self._closed.is_set():
                    return
                actor = _Actor(self._ray, self._remote.remote(self._terms))
                self._actors.add(actor)
            try:
                if self._begin(actor):
                    failed = 0
                    while (job := self._next(actor)) is not None:
                        self._do(actor, job)
            except Exception as error:
                failed += 1
                if failed >= TRIES or not isinstance(error, self._lost):
                    self._refuse(error)
            finally:
                self._end(actor)

    def _begin(self, actor: _Actor) -> bool:
        """Wait until an actor has a place, and is told that it is right there; False: nothing more is wanted."""
        checked = actor.handle.check.remote()
        while not self._ray.wait([checked], timeout=_LOOK)[0]:
            if self._closed.is_set():
                return False
        wrong = self._ray.get(checked)
        if wrong is not None:
            wrong.reraise()
        actor.answered, actor.ready = time.monotonic(), True
        return True

    def _refuse(self, error: Exception) -> None:
        """Say of a unit that there is no actor for it."""
        job = self._next()
        if job is not None:
            if isinstance(error, self._lost):
                found, fix = _line(error), "Do all nodes have robocas-ms3, in the same Python?"
                error = PlanError("actors of Ray don't start", where="--on ray", found=found, fix=fix)
            job.future.set_exception(error)

    def _next(self, actor: _Actor | None = None) -> _Job | None:
        while not (self._closed.is_set() or (actor is not None and actor.gone)):
            try:
                job = self._jobs.get(timeout=_LOOK)
            except Empty:
                continue
            if job.future.running() or job.future.set_running_or_notify_cancel():
                return job
        return None

    def _do(self, actor: _Actor, job: _Job) -> None:
        try:
            found = self._gather(actor, job.unit) if self._options.gather else self._wait(actor, job.unit)
        except self._lost as error:
            self._end(actor)
            if not self._options.gather:
                self._closed.wait(max(0.0, actor.answered + LEASE + ENDING - time.monotonic()))
            self._again(job, error)
        except Exception as error:
            if self._options.gather:
                self._end(actor)  # it may be at the unit yet
            job.future.set_exception(error)
        else:
            job.future.set_result(found)

    def _wait(self, actor: _Actor, unit: Unit) -> list[Outcome]:
        found = self._ray.get(actor.handle.do.remote(unit))
        if isinstance(found, SentError):
            found.reraise()
        return found

    def _gather(self, actor: _Actor, unit: Unit) -> list[Outcome]:
        folder = unit.folder(self._plan, self._out)
        if not unit.is_done(self._plan, self._out):
            arriving = Arriving(folder)
            begun = {name: (folder / name).read_bytes() for name in (LEDGER, DEATHS) if (folder / name).is_file()}
            send = actor.handle.send.options(num_returns="streaming", _generator_backpressure_num_objects=_AHEAD)
            for reference in send.remote(unit, begun):
                came = self._ray.get(reference)
                if isinstance(came, SentError):
                    came.reraise()
                elif isinstance(came, Outcome):
                    arriving.keep(came)
                else:
                    arriving.take(came)
            arriving.keep()
        return unit.result(self._plan, self._out)

    def _again(self, job: _Job, error: Exception) -> None:
        """Have a unit done by another actor, unless it goes on losing them without getting further."""
        folder = job.unit.folder(self._plan, self._out)
        seeds = len(outcomes(folder))
        job.lost, job.seeds = (job.lost + 1 if seeds == job.seeds else 1), seeds
        if job.lost < TRIES:
            self._jobs.put(job)
            return
        what, found = "the actors of Ray that were at this unit died", f"{job.lost} times; {_line(error)}"
        fix = "Is memory short on the nodes? --resume goes on."
        job.future.set_exception(PlanError(what, where=folder, found=found, fix=fix))

    def _end(self, actor: _Actor) -> None:
        with self._lock:
            if self._closed.is_set():
                return  # `close` does it, and lets it tidy up
            self._actors.discard(actor)
        actor.end()

    def close(self) -> None:
        """End the actors, and the cluster if it was started here."""
        with self._lock:
            self._closed.set()
            actors = list(self._actors)
        closing = [actor.handle.close.remote() for actor in actors if actor.ready]
        if closing:
            self._ray.wait(closing, num_returns=len(closing), timeout=_CLOSING)
        for actor in actors:
            actor.end()
        for thread in self._threads:
            thread.join(_JOINING)
        while not self._jobs.empty():
            job = self._jobs.get()
            if not job.future.cancel():
                job.future.set_exception(CancelledError())
        if self._disconnects:
            self._ray.shutdown()


def _line(error: Exception) -> str:
    return " ".join(f"{error}".split())[:300]
