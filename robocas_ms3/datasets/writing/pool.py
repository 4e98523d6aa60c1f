"""Does what writes datasets in this process or in several, which render beside each other."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import NoReturn, TypeVar

from robocas_ms3.errors import DatasetError
from robocas_ms3.processes import Pool, Worker, use_one_torch_thread

Task = TypeVar("Task")
Result = TypeVar("Result")


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

    def died(task: Task) -> NoReturn:
        fix = "Is memory short? Pass --resume and fewer --jobs."
        raise DatasetError("a worker process died", where=where, fix=fix)

    processes = min(processes, len(tasks))
    here = one_torch_thread() if renders and processes <= 1 else nullcontext()
    opened = partial(_open_renderer, open_worker) if renders and processes > 1 else open_worker
    with here, Pool(opened, processes, died=died) as pool:
        yield from pool.do(tasks)


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


def _open_renderer(open_worker: Callable[[], Worker[Task, Result]]) -> Worker[Task, Result]:
    """In one of several processes."""
    # One thread a process: several that render in software on all cores get in each other's way.
    os.environ.setdefault("LP_NUM_THREADS", "1")
    use_one_torch_thread()
    return open_worker()
