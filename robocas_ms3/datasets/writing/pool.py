"""Does what writes datasets in this process or in several, which render beside each other."""

from __future__ import annotations

import errno
import logging
import os
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing, contextmanager, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Generic, TypeVar

from robocas_ms3.core.errors import DatasetError, IncompleteError, MissingExtraError, RobocasError
from robocas_ms3.core.sent_errors import SentError
from robocas_ms3.core.words import count_of
from robocas_ms3.core.workers import NO_LIMITS, Limits, Worker, WorkerPool, use_one_torch_thread

Task = TypeVar("Task")
Result = TypeVar("Result")

_ENOUGH = 3  # that fail before any succeeds: others would fare no better
_TOLD = 5  # failures that an error tells
_log = logging.getLogger(__name__)


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
    begun: bool = False,
    fix: str = "",
) -> Generator[Result, None, None]:
    """Do tasks, each an episode; gives each result when it is there, in any order.

    One that fails costs no other, unless what is wrong befalls all: the disk, an extra, or the first three of them.

    Args:
        open_worker: makes what does them, once a process, and again after a failure; sent to the others by pickling.
        tasks: to be done.
        processes: how many work; with one it is this one.
        where: what is written, for the error.
        renders: whether they render; then torch has one thread in each process.
        limits: of each task.
        apart: whether even one process is not this one, so that limits hold and a crash of a library does not end it.
        name: of a task, for the error.
        begun: whether others were done before.
        fix: what to do about those that fail.

    Raises:
        IncompleteError: tasks failed, or their processes died twice; others are done.
        Exception: whatever a task raises, where none is done.
    """

    def crashed(task: Task, why: str) -> _Failed[Task]:
        error = DatasetError(f"its process died twice: {why}", where=name(task))
        return _Failed(task, SentError.of(error, "a worker"))

    processes = min(processes, len(tasks))
    here = processes <= 1 and not apart
    threads = one_torch_thread() if renders and here else nullcontext()
    opened = partial(_open_renderer, open_worker, processes) if renders and not here else open_worker
    careful = partial(_Careful[Task, Result], opened)
    pool: WorkerPool[Task, Result | _Failed[Task]] = WorkerPool(
        careful, 0 if here else processes, on_crash=crashed, limits=limits or NO_LIMITS
    )
    failed: list[_Failed[Task]] = []
    done = 0
    with threads, pool, closing(pool.map(tasks, ordered=False)) as results:
        for result in results:
            if not isinstance(result, _Failed):
                done += 1
                yield result
                continue
            failed.append(result)
            if done or begun:
                _log.warning("%s could not be written: %s", name(result.task), result.why)
            elif len(failed) == _ENOUGH:
                break
    if not failed:
        return
    if not (done or begun):
        raise failed[0].sent.with_traceback()
    reasons = {name(one.task): one.why for one in sorted(failed, key=lambda one: name(one.task))}
    raise _incomplete(reasons, where, fix) from failed[0].sent.with_traceback()


def _incomplete(reasons: dict[str, str], where: Path, fix: str) -> IncompleteError:
    said = [why if why.startswith(f"{one}: ") else f"{one}: {why}" for one, why in reasons.items()]
    more = f"; and {len(said) - _TOLD} more" if len(said) > _TOLD else ""
    what = f"{count_of(len(said), 'episode')} could not be written"
    error = IncompleteError(what, where=where, found="; ".join(said[:_TOLD]) + more, fix=fix)
    error.reasons = reasons
    return error


@dataclass(frozen=True)
class _Failed(Generic[Task]):
    """A task that could not be done, and the error."""

    task: Task
    sent: SentError

    @property
    def why(self) -> str:
        error = self.sent.error
        said = str(error) if isinstance(error, RobocasError) else f"{type(error).__name__}: {error}"
        return " ".join(said.split()).rstrip(".")


class _Careful(Generic[Task, Result]):
    """A worker that gives what goes wrong with a task as its result, and goes on with a new one of what it works with.

    Args:
        open_worker: makes that.
    """

    def __init__(self, open_worker: Callable[[], Worker[Task, Result]]) -> None:
        self._open_worker = open_worker
        self._worker: Worker[Task, Result] | None = open_worker()

    def run(self, task: Task) -> Result | _Failed[Task]:
        try:
            if self._worker is None:
                self._worker = self._open_worker()
            return self._worker.run(task)
        except Exception as error:
            if _befalls_all(error):
                raise
            self.close()
            return _Failed(task, SentError.of(error, "a worker"))

    def close(self) -> None:
        worker, self._worker = self._worker, None
        if worker is not None:
            worker.close()


def _befalls_all(error: Exception) -> bool:
    """Whether an error is the system's, or one of an installation: FFmpeg's errors have numbers of their own."""
    if isinstance(error, OSError) and error.errno in errno.errorcode:
        return True
    return isinstance(error, MissingExtraError)


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
