"""Worker objects that run in parallel, each in its own process, or one after the other in this process."""

from __future__ import annotations

import math
import os
import select
import signal
import threading
import time
import weakref
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from multiprocessing import Pipe
from typing import Any, Generic, TypeVar

from robocas_ms3.core.signals import defer_interrupts
from robocas_ms3.core.worker_process import START_SECONDS, Limits, ProcessCrashError, Worker, WorkerProcess

Task = TypeVar("Task")
Result = TypeVar("Result")

_POLL_MILLISECONDS = 200  # between two checks of signals and limits


class PinnedWorkers(Generic[Task, Result]):
    """Worker processes that each run one worker object; a crashed process is not replaced.

    Unlike in a `WorkerPool`, no other thread communicates with the processes, because steps of environments are short.
    The first call of `run` starts the processes.

    Args:
        make_workers: functions that make the worker objects, one per process; sent with cloudpickle.
        limits: time and memory limits of a task.

    Attributes:
        pids: ids of the processes; empty until they have started.
    """

    def __init__(self, make_workers: Sequence[Callable[[], Worker[Task, Result]]], limits: Limits) -> None:
        stop, self._stop_writer = Pipe(duplex=False)  # never readable: the calling thread is the only one
        self._processes = [WorkerProcess(make, limits, stop) for make in make_workers]
        self._seconds = limits.seconds
        self._unread: set[int] = set()  # numbers of processes that have not answered yet
        self.pids: list[int] = []
        self._owner, self._ended = os.getpid(), threading.Event()
        self._end = weakref.finalize(self, _end_processes, self._processes, self._unread, self._ended, self._owner)

    @property
    def closed(self) -> bool:
        """Whether the processes have ended, or belong to another process because this process is a fork of it."""
        return not self._end.alive or self._owner != os.getpid()

    @property
    def busy(self) -> bool:
        """Whether a process still runs a task of an interrupted call."""
        return bool(self._unread)

    def run(self, tasks: Sequence[Task]) -> list[Result]:
        """Send one task to each worker, and return the results in the order of the workers.

        Results of an interrupted call are read and dropped first.

        Raises:
            ProcessCrashError: a process crashed or exceeded a limit.
            Exception: error of making a worker, or of the first failed task.
        """
        if not self.pids:
            try:
                self._launch()
                self._exchange_messages((), START_SECONDS)
                self._exchange_messages([process.pickled_worker for process in self._processes], START_SECONDS)
            except BaseException:
                self.close()
                raise
        if self._unread:
            self._exchange_messages((), self._seconds)
        return self._exchange_messages(tasks, self._seconds)

    def close(self) -> None:
        """End the processes; kill those that run a task. In a fork of this process, do nothing."""
        self._end()

    def _launch(self) -> None:
        launched = Future[None]()
        threading.Thread(target=_launch_processes, args=(self._processes, launched, self._ended), daemon=True).start()
        launched.result()
        self.pids = [process.pid for process in self._processes]
        self._poll = select.poll()
        self._numbers = {process.connection.fileno(): i for i, process in enumerate(self._processes)}
        for descriptor in self._numbers:
            self._poll.register(descriptor, select.POLLIN)
        self._unread.update(range(len(self._processes)))  # each process reports that it is ready

    def _exchange_messages(self, messages: Sequence[Any], seconds: float) -> list[Any]:
        """Send one message to each process, or none; return all outstanding answers by process number."""
        answers: list[Any] = [None] * len(self._processes)
        errors: dict[int, Exception] = {}
        deadline = time.monotonic() + seconds
        while messages or self._unread:
            with defer_interrupts() as signals:  # so that no message is sent or read only partly
                for number, message in enumerate(messages):
                    self._processes[number].send(message)
                    self._unread.add(number)
                messages = ()
                while self._unread and not signals:
                    ready = {self._numbers[descriptor] for descriptor, _ in self._poll.poll(_POLL_MILLISECONDS)}
                    for number in self._unread - ready:
                        self._processes[number].check_limits(deadline)
                    for number in ready:  # a process may have answered and crashed since
                        self._processes[number].check_limits(math.inf)
                        self._unread.discard(number)
                        try:
                            answers[number] = self._processes[number].read()
                        except ProcessCrashError:
                            raise
                        except Exception as error:  # noqa: BLE001  (of a task; raised when all have answered)
                            errors[number] = error
        if errors:
            raise errors[min(errors)]
        return answers


class InProcessWorkers(Generic[Task, Result]):
    """Worker objects of this process, with the interface of `PinnedWorkers`; they run one after the other.

    Args:
        make_workers: functions that make the worker objects.
    """

    pids = ()
    busy = False

    def __init__(self, make_workers: Sequence[Callable[[], Worker[Task, Result]]]) -> None:
        self._workers, self.closed = [make() for make in make_workers], False

    def run(self, tasks: Sequence[Task]) -> list[Result]:
        """Run one task in each worker, and return the results in the order of the workers."""
        return [worker.run(task) for worker, task in zip(self._workers, tasks, strict=True)]

    def close(self) -> None:
        """Drop the workers."""
        self._workers, self.closed = [], True


def _launch_processes(processes: list[WorkerProcess[Any, Any]], launched: Future[None], ended: threading.Event) -> None:
    """Launch the processes in this thread, and keep the thread alive until they have ended."""
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # new processes inherit this, until they ignore Ctrl-C
    try:
        for process in processes:
            process.launch()
        launched.set_result(None)
    except BaseException as error:  # noqa: BLE001  (raised by the future)
        launched.set_exception(error)
    ended.wait()  # the processes are killed when the thread that started them ends


def _end_processes(
    processes: list[WorkerProcess[Any, Any]], busy: set[int], ended: threading.Event, owner: int
) -> None:
    if os.getpid() != owner:
        return
    for number, process in enumerate(processes):
        if number in busy:
            process.end()
        elif process.connection is not None:
            process.connection.close()
    for process in processes:
        process.quit()
    ended.set()
