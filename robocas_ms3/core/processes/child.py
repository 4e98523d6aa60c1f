"""A process that does one task after the other, and is ended where it takes too long or too much memory."""

from __future__ import annotations

import atexit
import math
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from typing import Any, Generic, TypeVar

import psutil
from tqdm import tqdm

from robocas_ms3.core.errors import RobocasError
from robocas_ms3.core.exits import exit_error, uninterrupted
from robocas_ms3.core.processes.lives import is_too_large, leave_with
from robocas_ms3.core.processes.sent import SentError
from robocas_ms3.core.processes.starting import end_with, start
from robocas_ms3.core.processes.worker import Worker
from robocas_ms3.core.words import escape_log_lines, escape_tracebacks

Task = TypeVar("Task")
Result = TypeVar("Result")

START = 900.0
"""Seconds that a process may take until it begins with its first task."""
_LOOK = 1.0  # s between two looks at a process's memory
_KILLED_TOO = 2.0  # s until this process hears of it as well, where somebody ends all of them at once


@dataclass(frozen=True)
class Limits:
    """What a task may take.

    Attributes:
        seconds: of wall-clock time.
        memory_gb: a process may use, each that it forked likewise.
    """

    seconds: float = math.inf
    memory_gb: float = math.inf


NO_LIMITS = Limits()


class ChildDied(Exception):
    """The process ended, or was ended; the message says why, in words that can be counted."""


class NotBegun(Exception):
    """The process failed, or died, before it could begin with its first task.

    Attributes:
        error: what it raised; None: it died.
    """

    def __init__(self, error: BaseException | None = None, why: str = "") -> None:
        super().__init__(str(error or why))
        self.error, self._why = error, why

    def said(self) -> BaseException:
        """The error for who asked."""
        what, fix = "a process ended before it could begin", "See what it said above; robocas doctor says what works."
        return self.error or RobocasError(what, found=self._why, fix=fix)


class Stopped(Exception):  # noqa: N818  (nothing is wrong)
    """Nothing more is wanted of the process."""


class Child(Generic[Task, Result]):
    """The process; it is started with the first task, and again with the next one after it died.

    Args:
        open_worker: makes what does the tasks, in the process; is pickled.
        memory_gb: it may use.
    """

    def __init__(self, open_worker: Callable[[], Worker[Task, Result]], memory_gb: float) -> None:
        self._open_worker, self._memory = open_worker, memory_gb
        self._guard = threading.Lock()  # of the process: begun, and ended by whoever comes first
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
            NotBegun: it died, or failed, before it could begin: not for the task.
            Stopped: `stop` was called.
            RobocasError: the system allows no more processes, memory or open files.
            Exception: whatever the task raises.
        """
        with self._guard:
            if self._closed:
                raise Stopped
            pipe = self._begun()
            self._busy = True
        try:
            pipe.send(task)
            answer = None if self._open else self._wait(pipe, START)
            if answer is None:  # it has begun
                self._open = True
                answer = self._wait(pipe, seconds)
        except (EOFError, OSError) as error:
            why = self._cause()
            if self._closed:
                raise Stopped from error
            if not self._open:
                raise NotBegun(why=why) from error
            raise ChildDied(why) from error
        finally:
            self._busy = False
        if isinstance(answer, SentError):
            if not self._open:
                raise NotBegun(answer.with_traceback())
            answer.reraise()
        return answer

    def _wait(self, pipe: Any, seconds: float) -> Any:
        until = time.monotonic() + seconds
        while not pipe.poll(_LOOK):
            why = "too slow" if time.monotonic() > until else "too much memory" if self._is_too_large() else ""
            if why:
                self.end()
                if self._closed:
                    raise Stopped
                raise ChildDied(why) if self._open else NotBegun(why=why)
        return pipe.recv()

    def _is_too_large(self) -> bool:
        return self._memory < math.inf and is_too_large(self._process.pid, self._memory)

    def _cause(self) -> str:
        """Why the process died."""
        self._process.join(5)
        code = self._process.exitcode
        if code in (-signal.SIGTERM, -signal.SIGKILL) and not self._closed:
            time.sleep(_KILLED_TOO)  # else a seed would be blamed for what befell all
        self.end()
        return signal.Signals(-code).name if code is not None and code < 0 else f"exit code {code}"

    def _begun(self) -> Any:
        if self._process is None or not self._process.is_alive():
            self._end()
            try:
                self._begin()
            except OSError as error:
                what, fix = "can't start another process", "Use fewer --jobs, or raise the limits (ulimit -u, -n)."
                raise RobocasError(what, found=error.strerror or error, fix=fix) from error
        return self._pipe

    def _begin(self) -> None:
        context = multiprocessing.get_context("spawn")
        resource_tracker.ensure_running()  # not below: it lets Ctrl-C in again
        ours, theirs = context.Pipe()
        process = context.Process(target=_serve, args=(self._open_worker, theirs, os.getpid()), daemon=True)
        try:
            with uninterrupted():  # the process inherits that until it can deal with Ctrl-C
                start(process)
        except BaseException:
            ours.close()
            raise
        finally:
            theirs.close()
        self._process, self._pipe, self._open = process, ours, False

    def stop(self) -> None:
        """Want nothing more of the process; does not wait for its end. Another thread's `do` raises `Stopped`."""
        with self._guard:
            self._closed = True
            if self._process is not None:
                if self._busy:
                    _kill(self._process)
                else:
                    self._pipe.close()  # it leaves by itself

    def wait(self, seconds: float) -> None:
        """Wait for the end of a process that was stopped, and end it where it takes longer."""
        process = self._process
        if process is not None:
            process.join(seconds)
            _kill(process)

    def end(self) -> None:
        """End the process, whatever it is at; the next task gets another."""
        with self._guard:
            self._end()

    def _end(self) -> None:
        if self._process is not None:
            _kill(self._process)
            self._process.join()
            self._process = None
        if self._pipe is not None:
            self._pipe.close()
            self._pipe = None


def _kill(process: Any) -> None:
    """Kill a process and what it forked, which must not write on."""
    with suppress(psutil.Error):
        for forked in psutil.Process(process.pid).children(recursive=True):
            forked.kill()
    process.kill()


def _serve(open_worker: Callable[[], Worker[Any, Any]], pipe: Connection, parent: int) -> None:
    for number in (signal.SIGINT, signal.SIGTERM):  # which all of a group or a job may get: its parent ends it
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    end_with(parent)
    leave_with(parent)
    escape_log_lines()
    escape_tracebacks()
    tqdm.set_lock(threading.RLock())  # its own is the system's, which a process that is killed leaves behind
    worker: Worker[Any, Any] | None = None
    while True:
        try:
            task = pipe.recv()
        except EOFError:
            break
        try:
            if worker is None:
                worker = open_worker()
                pipe.send(None)
            answer = worker.do(task)
        except KeyboardInterrupt as error:  # no signal's: the process ignores those
            answer = SentError.of(exit_error(error, "a worker"), "a worker")
        except BaseException as error:  # noqa: BLE001  (it is raised again where it can be dealt with)
            answer = SentError.of(error, "a worker")
        try:
            pipe.send(answer)
        except Exception as error:  # the result can't be sent
            pipe.send(SentError.of(error, "a worker"))
    atexit._run_exitfuncs()
    os._exit(0)  # without what torch and SAPIEN do in the end: a second, while one waits who pressed Ctrl-C
