"""Does tasks in this process or in several, each of which keeps open what the tasks need."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any, Protocol, TypeVar

from robocas_ms3.demos.parent import leave_with_parent
from robocas_ms3.errors import DatasetError

Task = TypeVar("Task")
Result = TypeVar("Result")
Task_contra = TypeVar("Task_contra", contravariant=True)
Result_co = TypeVar("Result_co", covariant=True)


class Worker(Protocol[Task_contra, Result_co]):
    """Does one task after the other."""

    def do(self, task: Task_contra) -> Result_co:
        """Do a task."""
        ...

    def close(self) -> None:
        """Free what it holds."""
        ...


def do_all(
    open_worker: Callable[[], Worker[Task, Result]], tasks: Sequence[Task], processes: int, where: Path
) -> Generator[Result, None, None]:
    """Do tasks; gives each result when it is there, in any order.

    Args:
        open_worker: makes what does them, once a process; sent to the others by pickling.
        tasks: to be done.
        processes: how many work; with one it is this one.
        where: what is written, for the error.

    Raises:
        DatasetError: a process died; else whatever a task raises.
    """
    if processes <= 1 or len(tasks) < 2:
        worker = open_worker()
        try:
            yield from map(worker.do, tasks)
        finally:
            worker.close()
        return
    pool = ProcessPoolExecutor(
        min(processes, len(tasks)),
        mp_context=multiprocessing.get_context("spawn"),  # a renderer does not survive a fork
        initializer=_start_worker,
        initargs=(open_worker,),
    )
    try:
        for future in as_completed([pool.submit(_do, task) for task in tasks]):
            yield future.result()
    except BrokenProcessPool as error:
        raise DatasetError(
            "a worker process died", where=where, fix="Is memory short? Pass --resume and fewer --jobs."
        ) from error
    finally:
        pool.shutdown(cancel_futures=True)


_worker: Worker[Any, Any] | None = None


def _start_worker(open_worker: Callable[[], Worker[Any, Any]]) -> None:
    global _worker  # noqa: PLW0603  (state of a worker process)
    # One thread a process: several that render in software on all cores get in each other's way.
    os.environ.setdefault("LP_NUM_THREADS", "1")
    leave_with_parent()
    _worker = open_worker()


def _do(task: Any) -> Any:
    assert _worker is not None
    return _worker.do(task)
