"""Units on this machine: a slot a job."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from robocas_ms3.plans.engines import refuse_options
from robocas_ms3.plans.plan import Plan
from robocas_ms3.plans.slot import Slot, Stages
from robocas_ms3.plans.units import Outcome, Unit


class LocalEngine:
    """Threads that each look after the processes of a slot; see `engines.Engine`."""

    lingers = 0.0  # they end with this process

    def __init__(
        self, plan: Plan, out: Path, jobs: int, options: Mapping[str, str] | None = None, stages: Stages | None = None
    ) -> None:
        self.check(options or {})
        self.slots = jobs
        self._idle = [Slot(plan, out, stages) for _ in range(jobs)]
        self._all, self._lock = list(self._idle), threading.Lock()
        self._threads = ThreadPoolExecutor(jobs, thread_name_prefix="slot")

    @staticmethod
    def check(options: Mapping[str, str]) -> None:
        """See that there are no options."""
        refuse_options("local", options)

    def submit(self, unit: Unit) -> Future[list[Outcome]]:
        """Have a unit done."""
        return self._threads.submit(self._do, unit)

    def _do(self, unit: Unit) -> list[Outcome]:
        with self._lock:
            slot = self._idle.pop()
        try:
            return slot.do(unit)
        finally:
            with self._lock:
                self._idle.append(slot)

    def close(self) -> None:
        """End the processes."""
        for slot in self._all:
            slot.stop()
        self._threads.shutdown(wait=False, cancel_futures=True)
        for slot in self._all:
            slot.close()
        self._threads.shutdown()
