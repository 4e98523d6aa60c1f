"""Ctrl-C: the first one ends the command, soon and in one line, whatever it is at; others change nothing."""

from __future__ import annotations

import atexit
import os
import signal
import sys
import threading
from contextlib import suppress
from types import FrameType

INTERRUPTED = 130  # what a shell reports of a program that Ctrl-C ended
_GRACE = 2.2  # s to end in: processes, files, policies


def heed_ctrl_c() -> None:
    """Let the first Ctrl-C be the only one, of a command that is this process's own program."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # not where a shell has it ignored
        signal.signal(signal.SIGINT, _interrupt)


def leave(code: int) -> None:
    """Leave the process, without what torch and SAPIEN do in the end, which takes a second, if it was interrupted."""
    if code == INTERRUPTED:
        atexit._run_exitfuncs()
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError):
                stream.flush()
        os._exit(INTERRUPTED)
    sys.exit(code)


def _interrupt(number: int, frame: FrameType | None) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # who is impatient would interrupt what ends the processes
    last = threading.Timer(_GRACE, os._exit, (INTERRUPTED,))
    last.daemon = True
    last.start()
    raise KeyboardInterrupt
