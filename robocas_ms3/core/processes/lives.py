"""Threads and memory of a worker process, and its end with the process that started it."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable

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
