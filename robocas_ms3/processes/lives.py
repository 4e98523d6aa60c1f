"""How a process lives beside others: its threads, its memory, Ctrl-C, its end."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from types import FrameType
from typing import Any

import psutil

_LOOK = 0.5  # s


def use_one_torch_thread() -> None:
    """Leave torch one thread for good: those of small operations wait for each other. For commands and workers."""
    import torch

    torch.set_num_threads(1)


def leave_with(parent: int, look: Callable[[], object] = lambda: time.sleep(_LOOK)) -> None:
    """End this process as soon as its parent is no more, whatever it is at.

    Not for a forked process, in which a thread may find locks held: see `demos.forking.set_up_child`.

    Args:
        parent: process id.
        look: waits a moment, and says whether there is another reason to end.
    """

    def watch() -> None:
        # not by the end of a pipe alone, which a fork of the parent may keep open
        while os.getppid() == parent and not look():
            pass
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Hold Ctrl-C back for a moment; processes that are started meanwhile inherit that."""
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
                restored.callback(signal.signal, number, handler)
        if came:
            held[came[0][0]](*came[0])


def is_too_large(pid: int, memory_gb: float, *, forks: bool = True) -> bool:
    """Whether a process, or one that it forked, uses more memory than it may.

    Args:
        pid: its id.
        memory_gb: it may use, each that it forked likewise.
        forks: whether it may have forked some, which takes milliseconds to find out.
    """
    try:
        process = psutil.Process(pid)
        forked = process.children(recursive=True) if forks else []
        return any(one.memory_info().rss > memory_gb * 2**30 for one in (process, *forked))
    except psutil.Error:
        return False  # it has just died
