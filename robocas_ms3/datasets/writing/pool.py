"""Does tasks in this process or in several, each of which keeps open what the tasks need."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager, nullcontext
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
    open_worker: Callable[[], Worker[Task, Result]],
    tasks: Sequence[Task],
    processes: int,
    where: Path,
    *,
    renders: bool = True,
) -> Generator[Result, None, None]:
    """Do tasks; gives each result when it is there, in any order.

    Args:
        open_worker: makes what does them, once a process; sent to the others by pickling.
        tasks: to be done.
        processes: how many work; with one it is this one.
        where: what is written, for the error.
        renders: whether they render; then torch has one thread in each process.

    Raises:
        DatasetError: a process died; else whatever a task raises.
    """
    if processes <= 1 or len(tasks) < 2:
        with one_torch_thread() if renders else nullcontext(), closing(open_worker()) as worker:
            yield from map(worker.do, tasks)
        return
    pool = ProcessPoolExecutor(
        min(processes, len(tasks)),
        mp_context=multiprocessing.get_context("spawn"),  # a renderer does not survive a fork
        initializer=_start_worker,
        initargs=(open_worker, renders),
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


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Let torch do with one thread what is done inside: beside a renderer its others spin, for twice the CPU time."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


_worker: Worker[Any, Any] | None = None


def _start_worker(open_worker: Callable[[], Worker[Any, Any]], renders: bool) -> None:
    global _worker  # noqa: PLW0603  (state of a worker process)
    leave_with_parent()
    if renders:
        # One thread a process: several that render in software on all cores get in each other's way.
        os.environ.setdefault("LP_NUM_THREADS", "1")
        import torch

        torch.set_num_threads(1)
    _worker = open_worker()


def _do(task: Any) -> Any:
    assert _worker is not None
    return _worker.do(task)
