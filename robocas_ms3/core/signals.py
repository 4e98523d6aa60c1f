"""Control how a process ends: Ctrl-C and SIGTERM, deferred interrupts, and exits in code of extensions."""

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
"""Exit status of a program ended by Ctrl-C (128 + SIGINT)."""
_TERMINATED = 143  # exit status after SIGTERM, which `timeout`, `kill` and batch systems send
_GRACE = 2.2  # s for clean-up: worker processes, files, policies
_SECOND = 0.5  # s; a SIGINT sooner after the first belongs to the same key press
_PR_SET_PDEATHSIG = 1


class _InterruptHandler:
    """Handler of Ctrl-C and SIGTERM in a command: the first signal ends the command within seconds.

    Python calls a signal handler only when native code returns or a `defer_interrupts` block ends. Until then, a second
    SIGINT ends the process at once: the first SIGINT wakes a thread, which ignores SIGINT for half a second, and then
    restores the system's default action. When the handler was called, further signals are ignored.
    """

    def __init__(self) -> None:
        self.installed = False
        self.protected = False  # from a second SIGINT
        self.code = INTERRUPTED
        self._handled = threading.Event()

    def install(self) -> None:
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # a shell may have set it to ignored
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
        for ignored in (signal.SIGINT, signal.SIGTERM):
            signal.signal(ignored, signal.SIG_IGN)  # further signals must not interrupt the clean-up
        self.code = _TERMINATED if number == signal.SIGTERM else INTERRUPTED
        last = threading.Timer(_GRACE, os._exit, (self.code,))
        last.daemon = True
        last.start()
        raise KeyboardInterrupt

    def is_armed(self) -> bool:
        """Return whether this handler is installed, and no signal was handled yet."""
        return self.installed and signal.getsignal(signal.SIGINT) == self.handle

    def arm(self) -> None:
        """Make the system restore the default action of SIGINT at the first SIGINT, if ``sysv_signal`` exists.

        A second SIGINT then ends the process even while native code keeps the thread of `_watch` from running.
        """
        libc = ctypes.CDLL(None)
        action = ctypes.create_string_buffer(1024)  # a `struct sigaction`; the handler is its first member
        if hasattr(libc, "sysv_signal") and libc.sigaction(int(signal.SIGINT), None, action) == 0:
            libc.sysv_signal(int(signal.SIGINT), ctypes.c_void_p.from_buffer(action))

    def _watch(self, signals: int) -> None:
        libc = ctypes.CDLL(None)  # only the main thread may call `signal.signal`
        while signal.SIGINT not in os.read(signals, 1):  # the pipe also receives SIGTERM
            pass
        default = signal.SIG_IGN
        while not self._handled.is_set():
            if not self.protected:
                libc.signal(int(signal.SIGINT), ctypes.c_void_p(int(default)))
            default = signal.SIG_DFL
            self._handled.wait(_SECOND)


_command = _InterruptHandler()


def handle_interrupts() -> None:
    """Install handlers so that the first Ctrl-C or SIGTERM ends this command within seconds."""
    _command.install()


def exit_command(code: int) -> NoReturn:
    """Exit the process with an exit status; skip the teardown of libraries if the command was interrupted."""
    if code == INTERRUPTED:
        exit_immediately(_command.code)
    sys.exit(code)


@contextmanager
def defer_interrupts(*, second_ends: bool = True) -> Iterator[list[Any]]:
    """Defer SIGINT and SIGTERM until the end of the block; yield the list of signals received so far.

    At the end of the block, the handler runs for the first of these signals only. A signal mask does not suffice: the
    system would deliver the signal to another thread, and Python would run the handler in the main thread.

    Args:
        second_ends: whether a second SIGINT, at least half a second after the first, ends the command at once.
    """
    received: list[tuple[int, FrameType | None]] = []
    held: dict[int, Any] = {}
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):
            if callable(handler := signal.getsignal(number)):
                held[number] = handler
                signal.signal(number, lambda number, frame: received.append((number, frame)))
    protected, _command.protected = _command.protected, _command.protected or not second_ends
    try:
        yield received
    finally:
        _command.protected = protected
        with ExitStack() as restored:  # a signal during this loop must not prevent the other restorations
            for number, handler in held.items():
                restored.callback(_restore, number, handler)
        if received:
            held[received[0][0]](*received[0])


def exit_immediately(code: int) -> NoReturn:
    """Run exit functions and end the process, without the teardown of torch and SAPIEN, which is slow or crashes."""
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError, AttributeError):  # a closed stream, or None as in a service
            stream.flush()
    os._exit(code)


def die_with_parent(parent: int) -> None:
    """Ask Linux to kill this process when its parent ends: the thread of process id ``parent`` that started it."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:
            os.kill(os.getpid(), signal.SIGKILL)


@contextmanager
def forbid_exit(source: str) -> Iterator[None]:
    """Convert attempts of an extension to end the process to ExtensionError.

    Such attempts are SystemExit, and KeyboardInterrupt without a signal.

    Args:
        source: name of the extension, for the message.
    """
    try:
        yield
    except (SystemExit, KeyboardInterrupt) as error:
        if isinstance(error, KeyboardInterrupt) and not _command.is_armed():  # a signal may have raised it
            raise
        raise make_exit_error(error, source) from error


def make_exit_error(error: BaseException, source: str) -> ExtensionError:
    """Make an ExtensionError that names the line of the extension's code that tried to end the process."""
    frames = extract_tb(error.__traceback__)
    line = f" at {frames[-1].filename}:{frames[-1].lineno}" if frames else ""
    fix = "Raise an Exception instead of ending the process."
    return ExtensionError("this code tried to end the process", where=source, found=f"{error!r}{line}", fix=fix)


def _restore(number: int, handler: Any) -> None:
    signal.signal(number, handler)
    if number == signal.SIGINT and handler == _command.handle:
        _command.arm()
