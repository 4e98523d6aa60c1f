"""Tasks done by several processes.

What `Pool` promises, wherever it is used:

- Processes are spawned: neither a renderer, nor CUDA, nor a lock that a thread holds survives a fork.
- Each opens what its tasks need once, with the first of them; an error in that is the task's.
- A process that dies (memory, a crash in C++), or takes more than it may, costs no task but its own, which is begun
  again once, by another process.
- Ctrl-C ends the tasks under way and begins no others; the processes print nothing of it.
- However the process that uses it ends, the others end too.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from itertools import islice
from queue import Empty, SimpleQueue
from typing import Any, Generic, TypeVar

from robocas_ms3.core.errors import RobocasError
from robocas_ms3.core.exits import responsive, uninterrupted
from robocas_ms3.core.processes.child import NO_LIMITS, Child, ChildDied, Limits, NotBegun
from robocas_ms3.core.processes.worker import Worker

Task = TypeVar("Task")
Result = TypeVar("Result")

_AHEAD = 2  # tasks a process that are under way, so that none waits for the next
_GRACE = 1.0  # s that processes have to leave in
_LOOK = 1.0  # s between two looks whether a signal came
_log = logging.getLogger(__name__)


class Pool(Generic[Task, Result]):
    """Processes that do tasks, or this one alone.

    Args:
        open_worker: makes what does the tasks, once a process; is pickled, as tasks and results are.
        processes: how many work; with one it is this one.
        died: gives the result of a task whose process died twice, and why, or raises what is to be said of it; default:
            an error.
        here: whether this process does them, without limits; default: if one process is enough.
        limits: of each task.
    """

    def __init__(
        self,
        open_worker: Callable[[], Worker[Task, Result]],
        processes: int,
        *,
        died: Callable[[Task, str], Result] | None = None,
        here: bool | None = None,
        limits: Limits = NO_LIMITS,
    ) -> None:
        self._open_worker, self._processes, self._died = open_worker, max(1, processes), died or _refuse
        self._here = processes <= 1 if here is None else here
        self._limits = limits
        self._worker: Worker[Task, Result] | None = None
        self._children: list[Child[Task, Result]] = []
        self._idle: list[Child[Task, Result]] = []
        self._threads: ThreadPoolExecutor | None = None  # one looks after each process

    def do(self, tasks: Iterable[Task], *, in_order: bool = False) -> Generator[Result, None, None]:
        """Do tasks, which are taken as they are needed: they may have no end.

        Args:
            tasks: to be done.
            in_order: whether results come in the order of the tasks, or each when it is there.

        Raises:
            RobocasError: a process died at a task, if nothing else was asked for, or none can begin; else whatever a
                task raises.
        """
        return self._do_here(tasks) if self._here else self._do_elsewhere(tasks, in_order)

    def _do_here(self, tasks: Iterable[Task]) -> Generator[Result, None, None]:
        for task in tasks:
            if self._worker is None:
                self._worker = self._open_worker()
            yield self._worker.do(task)

    def _do_elsewhere(self, tasks: Iterable[Task], in_order: bool) -> Generator[Result, None, None]:
        left = iter(tasks)
        under_way: list[Future[Result]] = []  # the first ones first
        done: SimpleQueue[Future[Result]] = SimpleQueue()
        try:
            while True:
                for task in islice(left, _AHEAD * self._processes - len(under_way)):
                    under_way.append(self._submit(task))
                    under_way[-1].add_done_callback(done.put)
                if not under_way:
                    return
                found = under_way[0] if in_order else _next_done(done)
                while not found.done():
                    _next_done(done)
                under_way.remove(found)
                yield found.result()
        finally:
            for future in under_way:
                future.cancel()

    def _submit(self, task: Task) -> Future[Result]:
        if self._threads is None:
            self._children = [Child(self._open_worker, self._limits.memory_gb) for _ in range(self._processes)]
            self._idle = list(self._children)
            self._threads = ThreadPoolExecutor(self._processes, thread_name_prefix="process")
        return self._threads.submit(self._do_in_child, task)

    def _do_in_child(self, task: Task) -> Result:
        child = self._idle.pop()
        try:
            why = ""
            for last in (False, True):
                try:
                    return child.do(task, self._limits.seconds)
                except NotBegun as failed:
                    if failed.error is not None or last:
                        raise failed.said() from failed.error
                except ChildDied as death:
                    why = str(death)
                    if not last:
                        _log.warning("%s: the process that was at this died (%s); it is begun again", _named(task), why)
            return self._died(task, why)
        finally:
            self._idle.append(child)

    def __enter__(self) -> Pool[Task, Result]:
        return self

    def __exit__(self, *error: object) -> None:
        """End the processes, whatever they are at."""
        with uninterrupted():  # one who is impatient would leave them behind
            if self._threads is not None:
                self._threads.shutdown(wait=False, cancel_futures=True)
                for child in self._children:
                    child.stop()
                until = time.monotonic() + _GRACE
                for child in self._children:
                    child.wait(max(0.0, until - time.monotonic()))
                self._threads.shutdown()
                self._threads = None
        if self._worker is not None:
            self._worker.close()
            self._worker = None


def _named(task: Any) -> str:
    return f"{task}"[:80]


def _refuse(task: Any, why: str) -> Any:
    what, fix = "the process that was at this died", "Is memory short? Use fewer --jobs."
    raise RobocasError(what, where=_named(task), found=why, fix=fix)


def _next_done(done: SimpleQueue[Future[Any]]) -> Future[Any]:
    """What is done next.

    Not by `concurrent.futures.wait`: Ctrl-C at the wrong moment leaves its locks held for good. And with looks, since a
    signal that another thread got wakes nobody here.
    """
    while True:
        with suppress(Empty), responsive():
            return done.get(timeout=_LOOK)
