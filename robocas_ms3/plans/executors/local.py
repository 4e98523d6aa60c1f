"""Work units on this machine: a thread per job, each with two processes."""

from __future__ import annotations

from collections.abc import Sequence
from queue import SimpleQueue

from robocas_ms3.plans.executors import ThreadExecutor
from robocas_ms3.plans.units import Unit
from robocas_ms3.plans.worker import UnitWorker


class LocalExecutor(ThreadExecutor):
    """See `Executor`; it has no options."""

    def __enter__(self) -> LocalExecutor:
        self._workers = [self.open_worker(self.plan, self.out) for _ in range(self.jobs)]
        self._idle: SimpleQueue[UnitWorker] = SimpleQueue()
        for worker in self._workers:
            self._idle.put(worker)
        super().__enter__()
        return self

    def run(self, units: Sequence[Unit]) -> None:
        """Do some units by an idle worker."""
        worker = self._idle.get()
        try:
            for unit in units:
                worker.do(unit)
        finally:
            self._idle.put(worker)

    def __exit__(self, *error: object) -> None:
        for worker in self._workers:
            worker.stop()
        self.threads.shutdown(cancel_futures=True)
        for worker in self._workers:
            worker.close()
