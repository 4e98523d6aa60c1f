"""A worker process: start it, send tasks to it, and kill it when a task exceeds its limits."""

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
from robocas_ms3.core.signals import die_with_parent, exit_immediately, make_exit_error
from robocas_ms3.core.text import escape_log_lines, escape_tracebacks

Task = TypeVar("Task")
Result = TypeVar("Result")
Task_contra = TypeVar("Task_contra", contravariant=True)
Result_co = TypeVar("Result_co", covariant=True)

START_SECONDS = 900.0  # limit for creating a worker
_EXIT_SECONDS = 1.0  # limit for the exit of an idle process
POLL_SECONDS = 1.0  # interval of the limit checks
_JOB_KILL_SECONDS = 2.0  # wait for the end of this process too: a batch system kills all processes of a job
# `multiprocessing` would import the user's main module again: that requires `if __name__ == "__main__"` and fails for a
# program read from standard input.
_PROGRAM = "import sys; sys.path[:] = {path!r}; from robocas_ms3.core.worker_process import main; main({fd}, {parent})"


@dataclass(frozen=True)
class Limits:
    """Limits of time and memory of one task; a task that exceeds a limit is killed."""

    seconds: float = math.inf  # wall-clock time
    memory_gb: float = math.inf  # GiB of resident memory, for the worker process and for each of its forks


NO_LIMITS = Limits()


class ProcessCrashError(WorkerCrashError):
    """The worker process ``pid`` died during a task.

    The separate type distinguishes this error from a `WorkerCrashError` that the code of a task raises.
    """

    pid = 0


class Worker(Protocol[Task_contra, Result_co]):
    """Interface of workers, which run tasks one after the other and keep resources between tasks."""

    def run(self, task: Task_contra, /) -> Result_co: ...

    def close(self) -> None:
        """Free the resources.

        Called after a task that raised an error, and when a pool without processes closes.
        """
        ...


class WorkerProcess(Generic[Task, Result]):
    """A process that runs tasks one after the other.

    Linux kills the process when the thread that started it ends, so this thread must stay alive.

    Args:
        make_worker: creates the worker; called in the process.
        limits: limits of each task.
        stop: a `Connection` that becomes readable when the running task must be killed.

    Attributes:
        connection: the `Connection` to the process; None: the process does not run.
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
        """Run a task and return its result; start the process if it does not run."""
        if self._process is None or self._process.poll() is not None:
            try:
                self.launch()
                self._receive(START_SECONDS)  # the process reads: later writes cannot block on a full pipe
                self.send(self.pickled_worker)
                self._receive(START_SECONDS)
            except ProcessCrashError as crash:
                what, fix = (
                    "a worker process crashed before its first task",
                    "See the output of the process above, and run robocas doctor.",
                )
                raise WorkerStartError(what, found=crash.found, fix=fix) from crash
            except BaseException:
                self.end()
                raise
        self.send(task)
        return self._receive(self._limits.seconds)

    def quit(self) -> None:
        """Let an idle process exit; kill the process if it is busy or does not exit within a second."""
        if self._process is not None:
            self.connection.close()
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(_EXIT_SECONDS)
        self.end()

    @property
    def pickled_worker(self) -> bytes:
        """First message to the process, which creates the worker; the answer is None, or the error."""
        return cloudpickle.dumps(self._make_worker)

    def launch(self) -> None:
        """Start the process; the process sends None when it is ready to read messages."""
        self.end()
        try:
            self.connection, theirs = Pipe()
            with theirs:
                program = _PROGRAM.format(path=sys.path, fd=theirs.fileno(), parent=os.getpid())
                command = [sys.executable, "-c", program]
                self._process = subprocess.Popen(command, stdin=subprocess.DEVNULL, pass_fds=(theirs.fileno(),))
        except OSError as error:
            what, fix = "cannot start another process", "Use fewer --jobs, or raise the limits (ulimit -u, -n)."
            raise RobocasError(what, found=error.strerror or error, fix=fix) from error

    def send(self, message: object) -> None:
        """Send a message; raise ProcessCrashError if the process has died."""
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
        """Kill the process and raise ProcessCrashError if it exceeds a limit.

        Args:
            deadline: end of the time limit, by `time.monotonic`.
        """
        now = time.monotonic()
        if now > deadline:
            raise self._crash("time limit exceeded")
        if now - self._checked > POLL_SECONDS:  # also if tasks are shorter than the interval
            self._checked = now
            if _exceeds_memory(self.pid, self._limits.memory_gb):
                raise self._crash("memory limit exceeded")

    def read(self) -> Any:
        """Read the answer of the process, which must have arrived.

        Raises:
            ProcessCrashError: the process died.
            Exception: the error of the task.
        """
        try:
            answer = self.connection.recv()
        except (EOFError, OSError) as error:
            raise self._crash() from error
        if isinstance(answer, RemoteError):
            answer.reraise()
        return answer

    def _crash(self, reason: str = "") -> ProcessCrashError:
        """Kill the process and return a ProcessCrashError with the reason."""
        assert self._process is not None
        if not reason:
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(5)
            code = self._process.returncode
            reason = signal.Signals(-code).name if code is not None and code < 0 else f"exit status {code}"
            if code in (-signal.SIGTERM, -signal.SIGKILL):
                wait([self._stop], _JOB_KILL_SECONDS)  # otherwise the task would be blamed for the end of the job
        error = ProcessCrashError("the worker process crashed", found=reason)
        error.pid = self.pid
        self.end()
        return error

    def end(self) -> None:
        """Kill the process and its forks, if the process runs."""
        if self._process is not None:
            _kill_tree(self._process)
            self._process = None
        if self.connection is not None:
            self.connection.close()
            self.connection = None


def make_worker_error(error: BaseException, where: str) -> RemoteError:
    """Convert an error in a worker to a RemoteError.

    A KeyboardInterrupt in a worker is an attempt of the code to end the process, because workers ignore Ctrl-C.
    """
    return RemoteError.from_error(
        make_exit_error(error, where) if isinstance(error, KeyboardInterrupt) else error, where
    )


def _exceeds_memory(pid: int, memory_gb: float) -> bool:
    """Return whether a process, or one of its forks, uses more than ``memory_gb`` GiB of resident memory."""
    if memory_gb == math.inf:
        return False
    try:
        process = psutil.Process(pid)
        return any(
            member.memory_info().rss > memory_gb * 2**30 for member in [process, *process.children(recursive=True)]
        )
    except psutil.Error:
        return False  # it has just ended


def _kill_tree(process: subprocess.Popen[bytes]) -> None:
    """Kill a process and its forks, so that none continues to write files; wait until the process has ended."""
    if process.poll() is not None:
        return  # another process may have this id by now
    with suppress(psutil.Error):
        for forked in psutil.Process(process.pid).children(recursive=True):
            forked.kill()
    process.kill()
    process.wait()


def main(descriptor: int, parent: int) -> None:
    """Run the tasks that process ``parent`` (an id) sends through a file descriptor, until the connection is closed."""
    for number in (signal.SIGINT, signal.SIGTERM):  # terminals and batch systems send these signals to all processes
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    die_with_parent(parent)
    os.set_inheritable(descriptor, False)
    escape_log_lines()
    escape_tracebacks()
    tqdm.set_lock(threading.RLock())  # the default lock is a system semaphore, which a killed process leaks
    with suppress(EOFError, OSError):
        _serve(Connection(descriptor))
    exit_immediately(0)


def _serve(connection: Connection) -> None:
    """Create the worker and run the tasks; answer each message with its result or a `RemoteError`."""
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
        answer = make_worker_error(error, "a worker")
    try:
        connection.send(answer)
    except OSError:
        raise
    except Exception as error:  # the result cannot be pickled
        connection.send(RemoteError.from_error(error, "a worker"))
