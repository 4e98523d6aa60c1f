"""Does what writes datasets in this process or in several, which render beside each other."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import TypeVar

from robocas_ms3.errors import DatasetError
from robocas_ms3.processes import NO_LIMITS, Limits, Pool, Worker, use_one_torch_thread

Task = TypeVar("Task")
Result = TypeVar("Result")


def do_all(
    open_worker: Callable[[], Worker[Task, Result]],
    tasks: Sequence[Task],
    processes: int,
    where: Path,
    *,
    renders: bool = True,
    limits: Limits | None = None,
    apart: bool = False,
    name: Callable[[Task], str] = str,
) -> Generator[Result, None, None]:
    """Do tasks; gives each result when it is there, in any order.

    Args:
        open_worker: makes what does them, once a process; sent to the others by pickling.
        tasks: to be done.
        processes: how many work; with one it is this one.
        where: what is written, for the error.
        renders: whether they render; then torch has one thread in each process.
        limits: of each task.
        apart: whether even one process is not this one, so that limits hold and a crash of a library does not end it.
        name: of a task, for the error.

    Raises:
        DatasetError: a process died twice at a task; the others are done before. Else whatever a task raises.
    """
    lost: dict[str, str] = {}

    def died(task: Task, why: str) -> None:
        lost[name(task)] = why

    processes = min(processes, len(tasks))
    here = processes <= 1 and not apart
    threads = one_torch_thread() if renders and here else nullcontext()
    opened = partial(_open_renderer, open_worker, processes) if renders and not here else open_worker
    pool: Pool[Task, Result | None] = Pool(opened, processes, died=died, here=here, limits=limits or NO_LIMITS)
    with threads, pool:
        for result in pool.do(tasks):
            if result is not None:
                yield result
    if lost:
        said = ", ".join(f"{one}: {why}" for one, why in sorted(lost.items()))
        fix = "Everything else is written. Is memory short? --resume tries again, maybe with fewer --jobs."
        raise DatasetError("these ended the process that wrote them, twice", where=where, found=said, fix=fix)


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Let torch do with one thread what is done inside: beside a renderer its others spin, for twice the CPU time."""
    import torch

    before = torch.get_num_threads()
    use_one_torch_thread()
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _open_renderer(open_worker: Callable[[], Worker[Task, Result]], processes: int) -> Worker[Task, Result]:
    """In a process of its own, of so many."""
    if processes > 1:  # that render in software on all cores get in each other's way
        os.environ.setdefault("LP_NUM_THREADS", "1")
    use_one_torch_thread()
    return open_worker()
