"""Run tasks in worker processes, with limits on time and memory; crashes of single processes are handled.

`WorkerPool` guarantees:

- Worker processes are spawned, not forked, since renderers, CUDA and locks of threads do not survive a fork. The user's
  main module is not imported again.
- Each process creates its worker before its first task, and again after a task that raised an error. An error of the
  creation is raised as the error of the task.
- A process that crashes or exceeds a limit affects only its own task, which another process retries once.
- The iterable of tasks may be infinite: tasks are taken as workers become free. Results are in task order, or in order
  of completion.
- Ctrl-C stops the running tasks and starts no others; the worker processes print nothing.
- The processes end when the program ends, even by ``kill -9``, and so do their forks that call `die_with_parent`.
"""

from __future__ import annotations

import logging
import os
import signal
import threading
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import CancelledError
from contextlib import suppress
from itertools import islice
from multiprocessing import Pipe
from queue import Empty, SimpleQueue
from typing import Any, Generic, TypeVar

from robocas_ms3.core.errors import WorkerCrashError, WorkerStartError
from robocas_ms3.core.signals import defer_interrupts
from robocas_ms3.core.worker_process import NO_LIMITS, Limits, ProcessCrashError, Worker, WorkerProcess

Task = TypeVar("Task")
Result = TypeVar("Result")

_POLL_SECONDS = 0.2  # interval of the checks for signals
_TASKS_PER_WORKER = 2  # running or queued, so that no worker has to wait
_RESULTS_PER_WORKER = 8  # finished, but waiting for the result of an earlier task
_log = logging.getLogger(__name__)


class FunctionWorker(Generic[Task, Result]):
    """A worker that calls a function for each task."""

    def __init__(self, function: Callable[[Task], Result]) -> None:
        self.run = function

    def close(self) -> None:
        """Do nothing."""


class WorkerPool(Generic[Task, Result]):
    """A pool of worker processes; a context manager that ends them.

    Args:
        make_worker: creates the worker in each process. It is sent with cloudpickle, so it may be defined in the main
            module. Tasks and results are pickled.
        num_workers: number of processes, started on demand; 0: tasks run in this process, without limits.
        limits: limits of each task.
        retries: number of retries of a task whose process crashed.
        on_crash: called with a task and the reason when the process of its last retry crashed; returns a result for the
            task, or raises an error. Default: raise `WorkerCrashError`.
    """

    def __init__(
        self,
        make_worker: Callable[[], Worker[Task, Result]],
        num_workers: int,
        *,
        limits: Limits = NO_LIMITS,
        retries: int = 1,
        on_crash: Callable[[Task, str], Result] | None = None,
    ) -> None:
        self._make_worker, self._num_workers, self._limits = make_worker, num_workers, limits
        self._retries, self._on_crash = retries, on_crash or _raise_crash
        self._worker: Worker[Task, Result] | None = None  # the worker of this process
        self._jobs: SimpleQueue[_PendingTask[Task, Result] | None] = SimpleQueue()
        self._threads: list[threading.Thread] = []  # each supervises one process
        self._owner = 0  # process id: a fork of this process has no threads
        self._stop_reader: Any = None  # a Connection; readable once the pool is stopped
        self._stop_writer: Any = None
        self._stopped = False

    def map(self, tasks: Iterable[Task], *, ordered: bool = True) -> Generator[Result, None, None]:
        """Run tasks and yield their results; take tasks from the iterable as workers become free.

        Args:
            tasks: the tasks; the iterable may be infinite.
            ordered: whether to yield results in task order instead of in order of completion.

        Raises:
            WorkerStartError: no process can start.
            CancelledError: another thread stopped the pool.
            Exception: any error of a task, of ``make_worker`` or of ``on_crash``.
        """
        if self._num_workers == 0:
            return self._map_in_this_process(tasks)
        return self._map_in_processes(tasks, ordered)

    def run(self, task: Task) -> Result:
        """Run one task and return its result; raise the errors of `map`."""
        (result,) = self.map([task])
        return result

    def _map_in_this_process(self, tasks: Iterable[Task]) -> Generator[Result, None, None]:
        for task in tasks:
            if self._worker is None:
                self._worker = self._make_worker()
            try:
                result = self._worker.run(task)
            except BaseException:
                self._close_worker()
                raise
            yield result

    def _map_in_processes(self, tasks: Iterable[Task], ordered: bool) -> Generator[Result, None, None]:
        remaining = iter(tasks)
        pending: list[_PendingTask[Task, Result]] = []  # in the order of the tasks
        finished: SimpleQueue[None] = SimpleQueue()
        most = (_TASKS_PER_WORKER + _RESULTS_PER_WORKER) * self._num_workers
        try:
            while True:
                unfinished = sum(not job.done for job in pending)
                free = min(_TASKS_PER_WORKER * self._num_workers - unfinished, most - len(pending))
                for task in islice(remaining, max(0, free)):
                    pending.append(_PendingTask(task, finished))
                    self._submit(pending[-1])
                if not pending:
                    return
                job = pending[0] if ordered else next((job for job in pending if job.done), pending[0])
                if not job.done:
                    self._wait(finished)
                    continue
                pending.remove(job)
                if job.error is not None:
                    raise job.error
                yield job.result  # pyright: ignore[reportReturnType]  (the job is done)
        finally:
            for job in pending:
                job.cancelled = True

    def _submit(self, job: _PendingTask[Task, Result]) -> None:
        if self._owner != os.getpid():
            self._owner, self._jobs = os.getpid(), SimpleQueue()
            self._stop_reader, self._stop_writer = Pipe(duplex=False)
            # daemons: a pool that was not closed must not block the end of the program
            self._threads = [threading.Thread(target=self._supervise, daemon=True) for _ in range(self._num_workers)]
            for thread in self._threads:
                thread.start()
        self._jobs.put(job)

    def _wait(self, finished: SimpleQueue[None]) -> None:
        """Wait until a job is done.

        `concurrent.futures` is not used, since its locks can stay held after Ctrl-C. The wait has a timeout, since a
        signal delivered to another thread does not wake this one.
        """
        while True:
            if self._stopped:
                raise CancelledError
            with suppress(Empty), defer_interrupts():
                finished.get(timeout=_POLL_SECONDS)
                return

    def _supervise(self) -> None:
        """Run tasks in one worker process; the pool has one such thread per process."""
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # inherited by the process, until it ignores Ctrl-C
        process: WorkerProcess[Task, Result] = WorkerProcess(self._make_worker, self._limits, self._stop_reader)
        while (job := self._jobs.get()) is not None and not self._stopped:
            if not job.cancelled:
                try:
                    job.result = self._run_with_retries(process, job.task)
                except BaseException as error:  # noqa: BLE001  (`map` raises it)
                    job.error = error
                job.done = True
                job.finished.put(None)
        process.quit()

    def _run_with_retries(self, process: WorkerProcess[Task, Result], task: Task) -> Result:
        reason = ""
        for retries_left in reversed(range(self._retries + 1)):
            try:
                return process.run(task)
            except WorkerStartError:
                if not retries_left:
                    raise
            except ProcessCrashError as crash:
                reason = str(crash.found)
                if retries_left:
                    _log.warning(
                        "%.80s: the worker process of this task crashed (%s); the task is retried", task, reason
                    )
        return self._on_crash(task, reason)

    def stop(self) -> None:
        """Kill the running tasks and let idle processes exit; return without waiting for them."""
        self._stopped = True
        if self._owner == os.getpid():
            self._stop_writer.close()
            for _ in self._threads:
                self._jobs.put(None)

    def close(self) -> None:
        self.stop()
        if self._owner == os.getpid():
            for thread in self._threads:
                thread.join()
            self._stop_reader.close()
        self._threads = []
        self._close_worker()

    def _close_worker(self) -> None:
        worker, self._worker = self._worker, None
        if worker is not None:
            worker.close()

    def __enter__(self) -> WorkerPool[Task, Result]:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


class _PendingTask(Generic[Task, Result]):
    """A task of `map` that waits, runs or is done: the task, its result, and a queue that is notified at the end."""

    def __init__(self, task: Task, finished: SimpleQueue[None]) -> None:
        self.task, self.finished = task, finished
        self.cancelled = self.done = False
        self.result: Result | None = None
        self.error: BaseException | None = None


def use_one_torch_thread() -> None:
    """Limit torch to one thread in this process, because threads slow down small operations."""
    import torch

    torch.set_num_threads(1)


def hide_cuda() -> None:
    """Hide CUDA devices from this process, so that it can be forked; call it before torch uses CUDA.

    A reset of a ManiSkill environment initializes CUDA if there is a device, even if the environment does not use it,
    because it saves the random state of all devices (`torch.random.fork_rng`). A process that uses CUDA cannot be
    forked.
    """
    os.environ["CUDA_VISIBLE_DEVICES"] = ""


def _raise_crash(task: Any, reason: str) -> Any:
    what, fix = "the worker process of this task crashed", "Use fewer --jobs if the memory is short."
    raise WorkerCrashError(what, where=f"{task}"[:80], found=reason, fix=fix)
