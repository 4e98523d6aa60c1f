"""Work units on this machine: a thread per job, each with two processes."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor

from robocas_ms3.core.strict import StrictModel
from robocas_ms3.plans.executors import Setting, ended_futures, read_options
from robocas_ms3.plans.units import Unit


class LocalExecutor:
    """See `executors.Executor`."""

    units_per_job = 1

    def __init__(self, setting: Setting) -> None:
        self.check(setting.options)
        self.jobs = setting.jobs
        self._workers = [setting.open_worker(setting.plan, setting.out) for _ in range(setting.jobs)]
        self._idle, self._lock = list(self._workers), threading.Lock()
        self._threads = ThreadPoolExecutor(setting.jobs, thread_name_prefix="plan")

    @staticmethod
    def check(options: Mapping[str, str]) -> None:
        """Check that there are no options."""
        read_options("local", StrictModel, options)

    def submit(self, groups: Sequence[Sequence[Unit]]) -> list[Future[None]]:
        """Start a thread for each group."""
        return [self._threads.submit(self._do, group) for group in groups]

    def _do(self, units: Sequence[Unit]) -> None:
        with self._lock:
            worker = self._idle.pop()
        try:
            for unit in units:
                worker.do(unit)
        finally:
            with self._lock:
                self._idle.append(worker)

    def ended(self, jobs: Sequence[Future[None]], seconds: float) -> list[Future[None]]:
        """Wait for a thread."""
        return ended_futures(jobs, seconds)

    def log_of(self, job: Future[None]) -> str:
        """Return nothing: errors of threads are raised."""
        return ""

    def close(self) -> None:
        """Kill the processes."""
        for worker in self._workers:
            worker.stop()
        self._threads.shutdown(wait=False, cancel_futures=True)
        for worker in self._workers:
            worker.close()
        self._threads.shutdown()
