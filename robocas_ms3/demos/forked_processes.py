"""Fork this process, and run a function in a forked child process."""

from __future__ import annotations

import gc
import logging
import os
import signal
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any, TypeVar, cast

import torch

from robocas_ms3.core.errors import RobocasError
from robocas_ms3.core.remote_errors import RemoteError
from robocas_ms3.core.signals import die_with_parent

T = TypeVar("T")

CANDIDATE_TIMEOUT = 300.0  # s of wall-clock time for one candidate
_log = logging.getLogger(__name__)


class ForkedProcessError(Exception):
    """A forked process crashed or exceeded its time limit."""


class ForkedProcessCrashError(ForkedProcessError):
    """A forked process ended before it sent a result."""


@dataclass(frozen=True)
class ForkedProcess:
    """A forked child process of this process.

    Attributes:
        pid: process id of the child.
        pipe: pipe to the child.
    """

    pid: int
    pipe: Connection

    def send(self, message: Any) -> None:
        try:
            self.pipe.send(message)
        except OSError as error:
            raise ForkedProcessCrashError("crashed") from error

    def receive(self, limit: float) -> Any:
        """Return the next message of the child.

        Raises:
            ForkedProcessError: no message arrived within ``limit`` s, or the child has ended.
        """
        try:
            if not self.pipe.poll(limit):
                raise ForkedProcessError("timed_out")
            return self.pipe.recv()
        except (EOFError, OSError) as error:  # it ended before or while it sent a message
            raise ForkedProcessCrashError("crashed") from error

    def kill(self) -> None:
        self.pipe.close()
        os.kill(self.pid, signal.SIGKILL)  # not waited for yet, so the id is not reused
        os.waitpid(self.pid, 0)


def fork() -> ForkedProcess | Connection:
    """Fork this process; return the child in the parent, and the pipe to the parent in the child."""
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:  # a service may have no streams
            stream.flush()
    try:
        own_end, other_end = cast("tuple[Connection, Connection]", Pipe())
        pid = os.fork()
    except OSError as error:
        raise RobocasError(
            "cannot fork another process",
            found=error.strerror,
            fix="Use fewer --jobs, raise the limits (ulimit -u, -n), or use --no-fork, which is slower.",
        ) from error
    (other_end if pid else own_end).close()
    return ForkedProcess(pid, own_end) if pid else other_end


def set_up_forked_process(parent: int) -> None:
    """Prepare a child process right after the fork.

    The child is killed when the process with the id ``parent`` ends.
    """
    die_with_parent(parent)
    gc.freeze()  # a garbage collection of all objects would copy the parent's memory
    torch.set_num_threads(1)  # fork keeps one thread only; a parallel loop would wait for the others forever
    # New streams, since threads of the parent may hold the locks of the old ones. They are line buffered, since the
    # process ends by os._exit, which does not flush.
    sys.stdout, sys.stderr = (
        stream and os.fdopen(os.dup(fd), "w", buffering=1) for fd, stream in ((1, sys.stdout), (2, sys.stderr))
    )


def find_reason_not_to_fork(*, renders: bool) -> str:
    """Return the reason why this process cannot be forked safely, or an empty string.

    ``renders`` says whether the process has an open renderer.
    """
    if sys.platform != "linux":
        return "this is not Linux"
    if renders:
        return "a renderer is open"
    if torch.cuda.is_initialized():
        return "CUDA is in use"
    return ""


@cache
def warn_cannot_fork(reason: str) -> None:
    """Log a warning that this process cannot be forked, once per reason."""
    _log.warning(
        "cannot fork (%s): failed attempts are undone by simulating from the reset again, which is slower", reason
    )


def run_in_forked_process(function: Callable[[], T], limit: float = CANDIDATE_TIMEOUT) -> T:
    """Run a function in a forked child process and return its result; this process does not change.

    A child that crashes is run once more. ``limit`` is its wall-clock time in s.

    Raises:
        ForkedProcessError: the child crashed twice or exceeded its time limit.
    """
    try:
        return _run_once(function, limit)
    except ForkedProcessCrashError:
        return _run_once(function, limit)


def _run_once(function: Callable[[], T], limit: float) -> T:
    parent = os.getpid()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        forked = fork()
        if not isinstance(forked, ForkedProcess):
            try:
                set_up_forked_process(parent)
                signal.pthread_sigmask(signal.SIG_SETMASK, before)
                answer = _call(function)
                try:
                    forked.send(answer)
                except Exception as error:  # noqa: BLE001  (the answer cannot be pickled)
                    forked.send(RemoteError.from_error(error, "a candidate"))
            finally:  # even an interrupt must not return to the code that the parent runs too
                os._exit(0)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    try:
        answer = forked.receive(limit)
    finally:
        forked.kill()
    if isinstance(answer, RemoteError):
        answer.reraise()
    return answer


def _call(function: Callable[[], T]) -> T | RemoteError:
    try:
        return function()
    except BaseException as error:  # noqa: BLE001  (the parent raises it)
        return RemoteError.from_error(error, "a candidate")
