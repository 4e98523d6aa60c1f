"""One worker process: started, given tasks, and killed when a task exceeds its limits."""

from __future__ import annotations

import math
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import CancelledError
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import Pipe
from multiprocessing.connection import Connection, wait
from typing import Any, Generic, Protocol, TypeVar

import cloudpickle
import psutil
from tqdm import tqdm

from robocas_ms3.core.errors import RobocasError, WorkerCrashError, WorkerStartError
from robocas_ms3.core.remote_errors import RemoteError
from robocas_ms3.core.signals import die_with_parent, exit_error, exit_immediately
from robocas_ms3.core.text import escape_log_lines, escape_tracebacks

Task = TypeVar("Task")
Result = TypeVar("Result")
Task_contra = TypeVar("Task_contra", contravariant=True)
Result_co = TypeVar("Result_co", covariant=True)

START_SECONDS = 900.0  # until a worker is made
_EXIT_SECONDS = 1.0  # until an idle process has left
POLL_SECONDS = 1.0  # between two checks of limits
_JOB_KILL_SECONDS = 2.0  # until this process is ended too, where a batch system ends all processes of a job
# Not `multiprocessing`, whose spawn runs the user's main module again: it needs `if __name__ == "__main__"` there, and
# fails in a program from standard input.
_PROGRAM = "import sys; sys.path[:] = {path!r}; from robocas_ms3.core.worker_process import main; main({fd}, {parent})"


@dataclass(frozen=True)
class Limits:
    """What one task may take."""

    seconds: float = math.inf  # wall-clock time
    memory_gb: float = math.inf  # GiB, resident, of the worker process and of each process that it forked


NO_LIMITS = Limits()


class ProcessCrashError(WorkerCrashError):
    """The worker process ``pid`` died during a task. A task that itself raises `WorkerCrashError` is not meant."""

    pid = 0


class Worker(Protocol[Task_contra, Result_co]):
    """Keeps what tasks need, and runs one task after the other."""

    def run(self, task: Task_contra, /) -> Result_co: ...

    def close(self) -> None:
        """Free what it holds: after a task that raised an error, and when a pool without processes is closed."""
        ...


class WorkerProcess(Generic[Task, Result]):
    """A process that runs one task after the other.

    The thread that starts it has to live as long: Linux kills a process when the thread that started it ends.

    Args:
        make_worker: is called in the process.
        limits: of each task.
        stop: a `Connection` that becomes readable when the running task has to be killed.

    Attributes:
        connection: to the process, a `Connection`.
    """

    def __init__(self, make_worker: Callable[[], Worker[Task, Result]], limits: Limits, stop: Any) -> None:
        self._make_worker, self._limits, self._stop = make_worker, limits, stop
        self._process: subprocess.Popen[bytes] | None = None
        self.connection: Any = None
        self._checked = 0.0  # time of the last check of the memory limit

    @property
    def pid(self) -> int:
        assert self._process is not None
        return self._process.pid

    def run(self, task: Task) -> Result:
        if self._process is None or self._process.poll() is not None:
            try:
                self.launch()
                self._receive(START_SECONDS)  # that it reads: nothing below waits for a full pipe
                self.send(self.pickled_worker)
                self._receive(START_SECONDS)
            except ProcessCrashError as crash:
                what, fix = "a worker process died before its first task", "See its output above, and robocas doctor."
                raise WorkerStartError(what, found=crash.found, fix=fix) from crash
            except BaseException:
                self.end()
                raise
        self.send(task)
        return self._receive(self._limits.seconds)

    def leave(self) -> None:
        """Let the process leave; kill it where that takes too long, or where it is busy."""
        if self._process is not None:
            self.connection.close()
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(_EXIT_SECONDS)
        self.end()

    @property
    def pickled_worker(self) -> bytes:
        """The first message to the process; the answer to it is None, or the error of making the worker."""
        return cloudpickle.dumps(self._make_worker)

    def launch(self) -> None:
        """Start the process, which answers None when it reads, before any message."""
        self.end()
        try:
            self.connection, theirs = Pipe()
            with theirs:
                program = _PROGRAM.format(path=sys.path, fd=theirs.fileno(), parent=os.getpid())
                command = [sys.executable, "-c", program]
                self._process = subprocess.Popen(command, stdin=subprocess.DEVNULL, pass_fds=(theirs.fileno(),))
        except OSError as error:
            what, fix = "can't start another process", "Use fewer --jobs, or raise the limits (ulimit -u, -n)."
            raise RobocasError(what, found=error.strerror or error, fix=fix) from error

    def send(self, message: object) -> None:
        """Send a message; raises ProcessCrashError."""
        try:
            self.connection.send(message)
        except OSError as error:
            raise self._crash() from error

    def _receive(self, seconds: float) -> Any:
        deadline = time.monotonic() + seconds
        ready: list[Any] = []
        while not ready:
            ready = wait([self.connection, self._stop], POLL_SECONDS)
            self.check_limits(math.inf if ready else deadline)
        if self._stop in ready:
            self.end()
            raise CancelledError
        return self.read()

    def check_limits(self, deadline: float) -> None:
        """Kill the process and raise ProcessCrashError if it exceeds the deadline (`time.monotonic`) or the memory."""
        now = time.monotonic()
        if now > deadline:
            raise self._crash("too slow")
        if now - self._checked > POLL_SECONDS:  # also where tasks are shorter than that
            self._checked = now
            if _exceeds_memory(self.pid, self._limits.memory_gb):
                raise self._crash("too much memory")

    def read(self) -> Any:
        """Read the answer that is there; raises ProcessCrashError, or the error of the task."""
        try:
            answer = self.connection.recv()
        except (EOFError, OSError) as error:
            raise self._crash() from error
        if isinstance(answer, RemoteError):
            answer.reraise()
        return answer

    def _crash(self, reason: str = "") -> ProcessCrashError:
        """End the process, and return the error that says why."""
        assert self._process is not None
        if not reason:
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(5)
            code = self._process.returncode
            reason = signal.Signals(-code).name if code is not None and code < 0 else f"exit code {code}"
            if code in (-signal.SIGTERM, -signal.SIGKILL):
                wait([self._stop], _JOB_KILL_SECONDS)  # else the task would be blamed for the end of all
        died = ProcessCrashError("its worker process died", found=reason)
        died.pid = self.pid
        self.end()
        return died

    def end(self) -> None:
        """Kill the process and what it forked, if it runs."""
        if self._process is not None:
            _kill_tree(self._process)
            self._process = None
        if self.connection is not None:
            self.connection.close()
            self.connection = None


def worker_error(error: BaseException, where: str) -> RemoteError:
    """Return an error of code in a worker, which may not end it: the process ignores Ctrl-C."""
    return RemoteError.of(exit_error(error, where) if isinstance(error, KeyboardInterrupt) else error, where)


def _exceeds_memory(pid: int, memory_gb: float) -> bool:
    """Return whether a process, or one that it forked, uses more than ``memory_gb`` GiB."""
    if memory_gb == math.inf:
        return False
    try:
        process = psutil.Process(pid)
        return any(one.memory_info().rss > memory_gb * 2**30 for one in [process, *process.children(recursive=True)])
    except psutil.Error:
        return False  # it has just ended


def _kill_tree(process: subprocess.Popen[bytes]) -> None:
    """Kill a process and what it forked, which must not go on writing files, and wait for its end."""
    if process.poll() is not None:
        return  # another process may have its id by now
    with suppress(psutil.Error):
        for forked in psutil.Process(process.pid).children(recursive=True):
            forked.kill()
    process.kill()
    process.wait()


def main(descriptor: int, parent: int) -> None:
    """Run tasks of the pool in process ``parent`` until it closes the connection, a file descriptor."""
    for number in (signal.SIGINT, signal.SIGTERM):  # a terminal or a batch system sends them to all processes
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    die_with_parent(parent)
    os.set_inheritable(descriptor, False)
    escape_log_lines()
    escape_tracebacks()
    tqdm.set_lock(threading.RLock())  # its own is a semaphore of the system, which a killed process leaves behind
    with suppress(EOFError, OSError):
        _serve(Connection(descriptor))
    exit_immediately(0)


def _serve(connection: Connection) -> None:
    """Make the worker, then run tasks; answer each message with a result or a `RemoteError`."""
    make_worker: Any = None
    worker: Any = None

    def start(pickled: bytes) -> None:
        nonlocal make_worker, worker
        make_worker = pickle.loads(pickled)
        worker = make_worker()

    def run(task: Any) -> Any:
        nonlocal worker
        if worker is None:
            worker = make_worker()
        try:
            return worker.run(task)
        except BaseException:
            failed, worker = worker, None
            failed.close()
            raise

    connection.send(None)
    _answer(connection, start)
    while True:
        _answer(connection, run)


def _answer(connection: Connection, function: Callable[[Any], Any]) -> None:
    message = connection.recv_bytes()
    try:
        answer = function(pickle.loads(message))
    except BaseException as error:  # noqa: BLE001  (it is raised again in the pool's process)
        answer = worker_error(error, "a worker")
    try:
        connection.send(answer)
    except OSError:
        raise
    except Exception as error:  # the result can't be pickled
        connection.send(RemoteError.of(error, "a worker"))
