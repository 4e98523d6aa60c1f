"""Run functions for an event loop in the thread that owns the policy."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor, Future
from functools import partial
from queue import SimpleQueue
from typing import Any


class CallerThreadExecutor(Executor):
    """Run submitted functions, one after another, in the thread that calls `run`.

    So a policy stays in the thread that made it, and Ctrl-C reaches its code, while another thread does the
    network's work. A submitted function that is cancelled before its turn is skipped.
    """

    def __init__(self) -> None:
        self._calls: SimpleQueue[tuple[Future[Any], Callable[[], Any]] | None] = SimpleQueue()
        self._ended = False

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Add a function to the queue."""
        future: Future[Any] = Future()
        self._calls.put((future, partial(fn, *args, **kwargs)))
        return future

    def run(self) -> None:
        """Run submitted functions until `shutdown`."""
        while (item := self._calls.get()) is not None and not self._ended:
            future, call = item
            if not future.set_running_or_notify_cancel():
                continue
            try:
                result = call()
            except Exception as error:  # raised by future.result() in the waiting thread
                future.set_exception(error)
            else:
                future.set_result(result)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End `run` after the function that it runs now."""
        self._ended = True
        self._calls.put(None)
