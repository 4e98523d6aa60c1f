"""Ctrl-C and SIGTERM: the first ends the command within seconds and in one line; later ones change nothing.

Python can't handle a signal during a long native call. There the second Ctrl-C ends the process at once (`exits`).
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable
from functools import wraps
from types import FrameType
from typing import ParamSpec

from robocas_ms3.core.exits import end_process, handle_interrupt

INTERRUPTED = 130  # what a shell reports of a program that Ctrl-C ended
_TERMINATED = 143  # and of one that `timeout`, `kill` or a batch system did
_GRACE = 2.2  # s to end in: processes, files, policies
_P = ParamSpec("_P")


def heed_ctrl_c() -> None:
    """Let the first Ctrl-C be the only one, of a command that is this process's own program."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # not where a shell has it ignored
        handle_interrupt(_interrupt)
    if signal.getsignal(signal.SIGTERM) is signal.SIG_DFL:
        signal.signal(signal.SIGTERM, _interrupt)


def resumable(command: Callable[_P, int]) -> Callable[_P, int]:
    """Decorate a command that continues its work when it is run again: Ctrl-C says so.

    With ``overwrite`` in its settings, it continues without that.
    """

    @wraps(command)
    def run(*args: _P.args, **kwargs: _P.kwargs) -> int:
        try:
            return command(*args, **kwargs)
        except KeyboardInterrupt:
            without = " without --overwrite" if any(getattr(cfg, "overwrite", False) for cfg in args) else ""
            raise KeyboardInterrupt(f"the same command{without} continues") from None

    return run


def leave(code: int) -> None:
    """Leave the process, at once if it was interrupted."""
    if code == INTERRUPTED:
        end_process(_code)
    sys.exit(code)


_code = INTERRUPTED


def _interrupt(number: int, frame: FrameType | None) -> None:
    global _code  # noqa: PLW0603  (a signal's handler has nobody to tell)
    for one in (signal.SIGINT, signal.SIGTERM):
        signal.signal(one, signal.SIG_IGN)  # who is impatient would interrupt what ends the processes
    _code = _TERMINATED if number == signal.SIGTERM else INTERRUPTED
    last = threading.Timer(_GRACE, os._exit, (_code,))
    last.daemon = True
    last.start()
    raise KeyboardInterrupt
