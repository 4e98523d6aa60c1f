"""A process that does one task after the other, and is ended where it takes too long or too much memory."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any, Generic, TypeVar

import psutil

from robocas_ms3.processes import SentError, Worker, leave_with

Task = TypeVar("Task")
Result = TypeVar("Result")

START = 900.0
"""Seconds that a process may take until it begins with its first task."""
_LOOK = 1.0  # s between two looks at a process's memory


class ChildDied(Exception):
    """The process ended, or was ended; the message says why, in words that can be counted."""


class Stopped(Exception):  # noqa: N818  (nothing is wrong)
    """Nothing more is wanted of the process."""


class Child(Generic[Task, Result]):
    """The process; it is started with the first task, and again with the next one after it died.

    Args:
        open_worker: makes what does the tasks, in the process; is pickled.
        memory_gb: it may use.
    """

    def __init__(self, open_worker: Callable[[], Worker[Task, Result]], memory_gb: float) -> None:
        self._open_worker, self._memory = open_worker, memory_gb * 2**30
        self._process: Any = None
        self._pipe: Any = None  # a Connection
        self._open = self._closed = self._busy = False

    def do(self, task: Task, seconds: float) -> Result:
        """Do a task.

        Args:
            task: it.
            seconds: it may take.

        Raises:
            ChildDied: the process died, or was ended for time or memory.
            Exception: whatever the task raises.
        """
        pipe = self._started()
        try:
            self._busy = True
            pipe.send(task)
            answer = None if self._open else self._wait(pipe, START)
            if answer is None:  # it has begun
                self._open = True
                answer = self._wait(pipe, seconds)
        except (EOFError, OSError) as error:
            if self._closed:
                raise Stopped from error
            self._process.join(5)
            code = self._process.exitcode
            why = signal.Signals(-code).name if code is not None and code < 0 else f"exit code {code}"
            self.end()
            raise ChildDied(why) from error
        finally:
            self._busy = False
        if isinstance(answer, SentError):
            answer.reraise()
        return answer

    def _wait(self, pipe: Any, seconds: float) -> Any:
        until = time.monotonic() + seconds
        while not pipe.poll(_LOOK):
            if time.monotonic() > until:
                self.end()
                raise ChildDied("too slow")
            if self._memory_used() > self._memory:
                self.end()
                raise ChildDied("too much memory")
        return pipe.recv()

    def _memory_used(self) -> int:
        try:
            return psutil.Process(self._process.pid).memory_info().rss
        except psutil.Error:
            return 0  # it has just died

    def _started(self) -> Any:
        if self._closed:
            raise Stopped
        if self._process is None or not self._process.is_alive():
            self.end()
            context = multiprocessing.get_context("spawn")
            self._pipe, theirs = context.Pipe()
            self._process = context.Process(target=_serve, args=(self._open_worker, theirs, os.getpid()), daemon=True)
            self._process.start()
            self._open = False
            theirs.close()
        return self._pipe

    def close(self) -> None:
        """End the process for good; may be called while another thread waits for it, which gets `Stopped`."""
        self._closed = True
        if self._process is not None:
            if not self._busy:
                self._pipe.close()  # it leaves by itself
                self._process.join(2)
            self._process.kill()

    def end(self) -> None:
        """End the process, whatever it is at; the next task gets another."""
        if self._process is not None:
            self._process.kill()
            self._process.join()
            self._process = None
        if self._pipe is not None:
            self._pipe.close()
            self._pipe = None


def _serve(open_worker: Callable[[], Worker[Any, Any]], pipe: Connection, parent: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # its parent ends it
    leave_with(parent)
    worker: Worker[Any, Any] | None = None
    while True:
        try:
            task = pipe.recv()
        except EOFError:
            return
        try:
            if worker is None:
                worker = open_worker()
                pipe.send(None)
            answer = worker.do(task)
        except BaseException as error:
            answer = SentError.of(error, "a worker")
        pipe.send(answer)
