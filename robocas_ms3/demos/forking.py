"""Fork a process: whether that is safe here, a pipe to the child, and what the child has to set right first."""

from __future__ import annotations

import ctypes
import logging
import os
import signal
import sys
from functools import cache
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import cast

import torch

from robocas_ms3.errors import RobocasError

_PR_SET_PDEATHSIG = 1
_log = logging.getLogger(__name__)


def piped_fork() -> tuple[Connection, Connection, int]:
    """Both ends of a pipe, the parent's first, and what ``os.fork`` gives.

    Raises:
        RobocasError: the system allows no more processes, memory or open files.
    """
    try:
        here, there = cast("tuple[Connection, Connection]", Pipe())
        return here, there, os.fork()
    except OSError as error:
        raise RobocasError(
            "can't start another process",
            found=error.strerror,
            fix="Use fewer --jobs, raise the limits (ulimit -u, -n), or --no-fork, which is slower.",
        ) from error


def die_with(parent: int) -> None:
    """Let the system kill this process when its parent ends."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it ended before that
        os._exit(0)


def streams_of_its_own() -> None:
    """Open the standard streams anew: threads that are not here may hold the locks of the parent's.

    A line is written as soon as it ends, since a child ends without ado. Where there is no stream, as in a service,
    none is opened.
    """
    sys.stdout, sys.stderr = (
        stream and os.fdopen(os.dup(fd), "w", buffering=1) for fd, stream in ((1, sys.stdout), (2, sys.stderr))
    )


def why_not_fork(*, renders: bool) -> str:
    """Why this process can't be forked safely; empty where it can.

    Args:
        renders: whether a renderer is open.
    """
    if sys.platform != "linux":
        return "this is not Linux"
    if renders:
        return "a renderer is open"
    if torch.cuda.is_initialized():
        return "CUDA is in use"
    return ""


@cache
def say_once(reason: str) -> None:
    """Tell the user that undoing takes longer here."""
    _log.warning("can't fork (%s): what fails is undone by simulating everything again", reason)
