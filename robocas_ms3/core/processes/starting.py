"""Starts processes that end with this one, whatever they are at.

The system kills a process together with its parent where that was asked for, and takes for its parent the thread that
started it. So all are started by one thread, which lives as long as this process.
"""

from __future__ import annotations

import atexit
import ctypes
import os
import signal
import sys
import threading
import weakref
from concurrent.futures import Future
from contextlib import suppress
from queue import SimpleQueue
from typing import Any

_PR_SET_PDEATHSIG = 1
_started: weakref.WeakSet[Any] = weakref.WeakSet()


class _Starter:
    """The thread; there is one once it is needed."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._asked: SimpleQueue[tuple[Any, set[Any], Future[None]]] | None = None

    def start(self, process: Any) -> None:
        with self._lock:
            if self._asked is None:
                self._asked = SimpleQueue()
                threading.Thread(target=_start_all, args=(self._asked,), name="starter", daemon=True).start()
        started: Future[None] = Future()
        self._asked.put((process, signal.pthread_sigmask(signal.SIG_BLOCK, ()), started))
        started.result()


def _start_all(asked: SimpleQueue[tuple[Any, set[Any], Future[None]]]) -> None:
    while True:
        process, held_back, started = asked.get()
        signal.pthread_sigmask(signal.SIG_SETMASK, held_back)
        try:
            process.start()
            _started.add(process)
        except BaseException as error:  # noqa: BLE001  (it is raised where it was asked for)
            started.set_exception(error)
        else:
            started.set_result(None)
        del process, started  # else the last one would be kept


@atexit.register
def _kill_all() -> None:
    """Before `multiprocessing` waits for what ignores its SIGTERM."""
    for process in list(_started):
        with suppress(ValueError):  # closed
            process.kill()


_starter = _Starter()
os.register_at_fork(after_in_child=_started.clear)  # a fork's parent's are none of its own
os.register_at_fork(after_in_child=_starter.__init__)  # a fork lacks the thread, and may have its lock held


def start(process: Any) -> None:
    """Start a process of `multiprocessing`; it gets the signals that the calling thread holds back.

    Raises:
        Exception: whatever starting it raises.
    """
    _starter.start(process)


def end_with(parent: int) -> None:
    """Have the system kill this process, which `start` started, when its parent ends; on Linux alone.

    A thread that looks for the parent (`lives.leave_with`) waits as long as native code holds Python's lock.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:  # it ended before that
            os._exit(1)
