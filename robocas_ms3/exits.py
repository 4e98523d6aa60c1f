"""What may end the process: Ctrl-C, which may be deferred, and foreign code, which may not (`no_exit`)."""

from __future__ import annotations

import ctypes
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from traceback import extract_tb
from types import FrameType
from typing import Any

from robocas_ms3.errors import ExtensionError

Handler = Callable[[int, FrameType | None], Any]
_commands: list[Handler] = []  # the handler of Ctrl-C that a command installed; none in a library


def handle_interrupt(handler: Handler) -> None:
    """Install a command's handler of SIGINT; a second SIGINT ends the process while Python can't run the handler."""
    signal.signal(signal.SIGINT, handler)
    _commands[:] = [handler]
    _let_second_end()


def was_interrupted() -> bool:
    """Return whether a ``KeyboardInterrupt`` may come from a signal: no, as long as a command waits for the first."""
    return signal.getsignal(signal.SIGINT) not in _commands


@contextmanager
def deferred_interrupts() -> Iterator[None]:
    """Handle a SIGINT or SIGTERM that comes inside afterwards, once; a second SIGINT ends the process at once."""
    with _deferred():
        if _commands:
            _let_second_end()
        yield


@contextmanager
def responsive() -> Iterator[None]:
    """Wait inside, in Python: a second SIGINT right after the first changes nothing."""
    handler = signal.getsignal(signal.SIGINT)
    armed = handler in _commands and threading.current_thread() is threading.main_thread()
    if armed:
        signal.signal(signal.SIGINT, handler)
    try:
        yield
    finally:
        if armed and not was_interrupted():
            _let_second_end()


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Hold Ctrl-C back for a moment; processes that are started during that inherit it."""
    with _deferred():
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            yield
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _deferred() -> Iterator[None]:
    """Call what deals with Ctrl-C and SIGTERM afterwards, once.

    A mask is not enough: the system gives the signal to another thread, of which Python tells the main one.
    """
    came: list[tuple[int, FrameType | None]] = []
    held: dict[int, Any] = {}
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):
            if callable(handler := signal.getsignal(number)):
                held[number] = handler
                signal.signal(number, lambda number, frame: came.append((number, frame)))
    try:
        yield
    finally:
        with ExitStack() as restored:  # one that comes now interrupts this, but not what is restored after it
            for number, handler in held.items():
                restored.callback(_restore, number, handler)
        if came:
            held[came[0][0]](*came[0])


@contextmanager
def no_exit(source: str) -> Iterator[None]:
    """Turn a ``SystemExit``, or a ``KeyboardInterrupt`` without a signal, of foreign code into an error.

    Args:
        source: whose code is called, such as ``policy mine:Policy``.

    Raises:
        ExtensionError: the code called ``sys.exit``, or raised ``KeyboardInterrupt``.
    """
    try:
        yield
    except (SystemExit, KeyboardInterrupt) as error:
        if isinstance(error, KeyboardInterrupt) and was_interrupted():
            raise
        raise exit_error(error, source) from error


def exit_error(error: BaseException, source: str) -> ExtensionError:
    """Make the error that says where foreign code tried to end the process."""
    frames = extract_tb(error.__traceback__)
    line = f" at {frames[-1].filename}:{frames[-1].lineno}" if frames else ""
    fix = "Raise an Exception there instead."
    return ExtensionError("this code tried to end the process", where=source, found=f"{error!r}{line}", fix=fix)


def _restore(number: int, handler: Handler) -> None:
    signal.signal(number, handler)
    if handler in _commands:
        _let_second_end()


def _let_second_end() -> None:
    """Let the system reset SIGINT to its default when the first one comes.

    Python only notes a signal, and calls its handler when native code returns. The second SIGINT then ends the process
    at once. The handler ends the command if it is called before that. Only where the C library has ``sysv_signal``.
    """
    libc = ctypes.CDLL(None)
    if not hasattr(libc, "sysv_signal"):
        return
    action = ctypes.create_string_buffer(1024)  # a `struct sigaction`, which begins with the handler
    if libc.sigaction(int(signal.SIGINT), None, action) == 0:
        libc.sysv_signal(int(signal.SIGINT), ctypes.c_void_p.from_buffer(action))
