"""What may end the process: Ctrl-C, which may be deferred, and foreign code, which may not (`forbid_exit`)."""

from __future__ import annotations

import atexit
import ctypes
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from traceback import extract_tb
from types import FrameType
from typing import Any, NoReturn

from robocas_ms3.core.errors import ExtensionError

INTERRUPTED = 130
"""Exit code of a program that Ctrl-C ended, as a shell reports it."""
_TERMINATED = 143  # and of one that `timeout`, `kill` or a batch system ended
_GRACE = 2.2  # s to end in: processes, files, policies
_SECOND = 0.5  # s from one SIGINT to the next that is a second one; sooner, it is the same key pressed, sent twice
_PR_SET_PDEATHSIG = 1


class _CommandInterrupt:
    """Ctrl-C and SIGTERM of a command: the first ends it within seconds, later ones change nothing.

    Python only notes a signal, and calls the handler when native code returns or a deferral ends. Until then a second
    SIGINT ends the process at once: a thread that learns of the first one ignores those of the next half second, and
    then restores the system's default.
    """

    def __init__(self) -> None:
        self.installed = False
        self.protected = False  # from the second SIGINT too
        self.code = INTERRUPTED
        self._handled = threading.Event()

    def install(self) -> None:
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # not where a shell has it ignored
            read, write = os.pipe()
            os.set_blocking(write, False)
            signal.set_wakeup_fd(write, warn_on_full_buffer=False)
            threading.Thread(target=self._watch, args=(read,), name="interrupts", daemon=True).start()
            self.installed = True
            signal.signal(signal.SIGINT, self.handle)
            self.arm()
        if signal.getsignal(signal.SIGTERM) is signal.SIG_DFL:
            signal.signal(signal.SIGTERM, self.handle)

    def handle(self, number: int, frame: FrameType | None) -> None:
        self._handled.set()
        for one in (signal.SIGINT, signal.SIGTERM):
            signal.signal(one, signal.SIG_IGN)  # who is impatient would interrupt what ends the processes
        self.code = _TERMINATED if number == signal.SIGTERM else INTERRUPTED
        last = threading.Timer(_GRACE, os._exit, (self.code,))
        last.daemon = True
        last.start()
        raise KeyboardInterrupt

    def waits(self) -> bool:
        return self.installed and signal.getsignal(signal.SIGINT) == self.handle

    def arm(self) -> None:
        """Let the system restore its default when the first SIGINT comes, if the C library has ``sysv_signal``.

        So the second one ends the process even while native code keeps the thread of `_watch` from running.
        """
        libc = ctypes.CDLL(None)
        action = ctypes.create_string_buffer(1024)  # a `struct sigaction`, which begins with the handler
        if hasattr(libc, "sysv_signal") and libc.sigaction(int(signal.SIGINT), None, action) == 0:
            libc.sysv_signal(int(signal.SIGINT), ctypes.c_void_p.from_buffer(action))

    def _watch(self, signals: int) -> None:
        libc = ctypes.CDLL(None)  # `signal.signal` is for the main thread alone
        while signal.SIGINT not in os.read(signals, 1):  # SIGTERM comes here too
            pass
        default = signal.SIG_IGN
        while not self._handled.is_set():
            if not self.protected:
                libc.signal(int(signal.SIGINT), ctypes.c_void_p(int(default)))
            default = signal.SIG_DFL
            self._handled.wait(_SECOND)


_command = _CommandInterrupt()


def handle_interrupts() -> None:
    """Let the first Ctrl-C or SIGTERM end this process, a command, within seconds; later ones change nothing."""
    _command.install()


def exit_command(code: int) -> NoReturn:
    """Leave the process with an exit code, at once if it was interrupted."""
    if code == INTERRUPTED:
        exit_immediately(_command.code)
    sys.exit(code)


@contextmanager
def deferred_interrupts(*, second_ends: bool = True) -> Iterator[list[Any]]:
    """Handle a SIGINT or SIGTERM that comes inside afterwards, once; gives the list that those that came are in.

    A signal mask is not enough: the system gives the signal to another thread, and Python tells the main thread.

    Args:
        second_ends: whether a second SIGINT, half a second after the first or later, ends a command at once.
    """
    came: list[tuple[int, FrameType | None]] = []
    held: dict[int, Any] = {}
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):
            if callable(handler := signal.getsignal(number)):
                held[number] = handler
                signal.signal(number, lambda number, frame: came.append((number, frame)))
    protected, _command.protected = _command.protected, _command.protected or not second_ends
    try:
        yield came
    finally:
        _command.protected = protected
        with ExitStack() as restored:  # one that comes now interrupts this, but not what is restored after it
            for number, handler in held.items():
                restored.callback(_restore, number, handler)
        if came:
            held[came[0][0]](*came[0])


def exit_immediately(code: int) -> NoReturn:
    """Run exit functions, and end the process without what torch and SAPIEN do then: it takes a second, or crashes."""
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError, AttributeError):  # a closed one, or none, as in a service
            stream.flush()
    os._exit(code)


def die_with_parent(parent: int) -> None:
    """Have Linux kill this process as soon as the thread that started it ends, of the process with id ``parent``."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:
            os.kill(os.getpid(), signal.SIGKILL)


@contextmanager
def forbid_exit(source: str) -> Iterator[None]:
    """Turn a SystemExit, or a KeyboardInterrupt without a signal, of the code of ``source`` into ExtensionError."""
    try:
        yield
    except (SystemExit, KeyboardInterrupt) as error:
        if isinstance(error, KeyboardInterrupt) and not _command.waits():  # it may come from a signal
            raise
        raise exit_error(error, source) from error


def exit_error(error: BaseException, source: str) -> ExtensionError:
    """Make the error that says where foreign code tried to end the process."""
    frames = extract_tb(error.__traceback__)
    line = f" at {frames[-1].filename}:{frames[-1].lineno}" if frames else ""
    fix = "Raise an Exception there instead."
    return ExtensionError("this code tried to end the process", where=source, found=f"{error!r}{line}", fix=fix)


def _restore(number: int, handler: Any) -> None:
    signal.signal(number, handler)
    if number == signal.SIGINT and handler == _command.handle:
        _command.arm()
