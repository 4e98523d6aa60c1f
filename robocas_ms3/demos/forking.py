"""Fork a process: whether that is safe here, the child, and a pipe between the two."""

from __future__ import annotations

import gc
import logging
import os
import signal
import sys
from dataclasses import dataclass
from functools import cache
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any, cast

import torch

from robocas_ms3.core.errors import RobocasError
from robocas_ms3.core.exits import die_with_parent

_log = logging.getLogger(__name__)


class ChildCrash(Exception):  # noqa: N818
    """A child took too long, or is gone."""


class ChildGone(ChildCrash):
    """A child has ended without a word."""


@dataclass(frozen=True)
class Child:
    """A forked process: its id, and the pipe to it."""

    pid: int
    pipe: Connection

    def send(self, message: Any) -> None:
        """Send a message; raises ``ChildGone`` if the child has ended."""
        try:
            self.pipe.send(message)
        except OSError as error:
            raise ChildGone("crashed") from error

    def receive(self, limit: float) -> Any:
        """Return the child's next message, within ``limit`` seconds.

        Raises:
            ChildGone: the child has ended.
            ChildCrash: no message in time.
        """
        try:
            if not self.pipe.poll(limit):
                raise ChildCrash("timed_out")
            return self.pipe.recv()
        except (EOFError, OSError) as error:  # it ended before it said anything, or in the middle of it
            raise ChildGone("crashed") from error

    def end(self) -> None:
        """Kill it, if it is there still."""
        self.pipe.close()
        os.kill(self.pid, signal.SIGKILL)  # it is still ours, if only as a zombie
        os.waitpid(self.pid, 0)


def fork() -> Child | Connection:
    """Fork this process; return the child, or in the child the pipe to this process.

    Raises:
        RobocasError: the system allows no more processes, memory or open files.
    """
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:  # as in a service
            stream.flush()
    try:
        here, there = cast("tuple[Connection, Connection]", Pipe())
        pid = os.fork()
    except OSError as error:
        raise RobocasError(
            "can't start another process",
            found=error.strerror,
            fix="Use fewer --jobs, raise the limits (ulimit -u, -n), or --no-fork, which is slower.",
        ) from error
    (there if pid else here).close()
    return Child(pid, here) if pid else there


def set_up_child(parent: int) -> None:
    """Set up a child before anything else; the system kills it when the process ``parent`` ends."""
    die_with_parent(parent)
    gc.freeze()  # a collection that walks all objects would copy all of the parent's memory
    # Threads that are not here may hold the locks of the parent's streams. A line is written as soon as it ends, since
    # a child ends without ado. Where there is no stream, as in a service, none is opened.
    sys.stdout, sys.stderr = (
        stream and os.fdopen(os.dup(fd), "w", buffering=1) for fd, stream in ((1, sys.stdout), (2, sys.stderr))
    )


def why_not_fork(*, renders: bool) -> str:
    """Return why this process, with or without an open renderer, can't be forked safely; empty where it can."""
    if sys.platform != "linux":
        return "this is not Linux"
    if renders:
        return "a renderer is open"
    if torch.cuda.is_initialized():
        return "CUDA is in use"
    return ""


@cache
def say_once(reason: str) -> None:
    """Warn the user that undoing takes longer here."""
    _log.warning("can't fork (%s): what fails is undone by simulating everything again", reason)
