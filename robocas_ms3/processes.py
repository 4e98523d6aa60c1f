"""Tasks done by several processes, errors sent between them, and the watch that ends one with its starter.

What `Pool` promises, wherever it is used:

- Processes are spawned: neither a renderer, nor CUDA, nor a lock that a thread holds survives a fork.
- Each opens what its tasks need once, with the first of them; an error in that is the task's.
- A process that dies (memory, a crash in C++) costs no task but its own: what was under way is done again one by one,
  which shows whose fault it is, and then the pool goes on as before.
- Ctrl-C interrupts the tasks under way and begins no others; the processes print nothing of it.
- However the process that uses it ends, the others end too.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import islice
from traceback import format_exception
from typing import Any, Generic, NoReturn, Protocol, TypeVar

from robocas_ms3.errors import RobocasError

Task = TypeVar("Task")
Result = TypeVar("Result")
Task_contra = TypeVar("Task_contra", contravariant=True)
Result_co = TypeVar("Result_co", covariant=True)

_AHEAD = 2  # tasks a process that are under way, so that none waits for the next
_LOOK = 0.5  # s


class Worker(Protocol[Task_contra, Result_co]):
    """Does one task after the other."""

    def do(self, task: Task_contra, /) -> Result_co:
        """Do a task."""
        ...

    def close(self) -> None:
        """Free what it holds."""
        ...


@dataclass(frozen=True)
class Calls(Generic[Task, Result]):
    """A worker that needs nothing: calls a function."""

    function: Callable[[Task], Result]

    def do(self, task: Task) -> Result:
        """Call it."""
        return self.function(task)

    def close(self) -> None:
        """Nothing is held."""


class Pool(Generic[Task, Result]):
    """Processes that do tasks, or this one alone.

    Args:
        open_worker: makes what does the tasks, once a process; is pickled, as tasks and results are.
        processes: how many work; with one it is this one.
        died: gives the result of a task whose process died, or raises what is to be said of it; default: an error.
        here: whether this process does them; default: if one process is enough.
    """

    def __init__(
        self,
        open_worker: Callable[[], Worker[Task, Result]],
        processes: int,
        *,
        died: Callable[[Task], Result] | None = None,
        here: bool | None = None,
    ) -> None:
        self._open_worker, self._processes, self._died = open_worker, max(1, processes), died or _refuse
        self._here = processes <= 1 if here is None else here
        self._worker: Worker[Task, Result] | None = None
        self._executor: ProcessPoolExecutor | None = None

    def do(self, tasks: Iterable[Task], *, in_order: bool = False) -> Generator[Result, None, None]:
        """Do tasks, which are taken as they are needed: they may have no end.

        Args:
            tasks: to be done.
            in_order: whether results come in the order of the tasks, or each when it is there.

        Raises:
            RobocasError: a process died at a task, if nothing else was asked for; else whatever a task raises.
        """
        return self._do_here(tasks) if self._here else self._do_elsewhere(tasks, in_order)

    def _do_here(self, tasks: Iterable[Task]) -> Generator[Result, None, None]:
        for task in tasks:
            if self._worker is None:
                self._worker = self._open_worker()
            yield self._worker.do(task)

    def _do_elsewhere(self, tasks: Iterable[Task], in_order: bool) -> Generator[Result, None, None]:
        numbered = enumerate(tasks)
        waiting: dict[int, Task] = {}  # those whose results are still to come, by number, the first ones first
        under_way: dict[int, Future[Result]] = {}
        suspects: set[int] = set()  # they were under way when a process died, and are done one by one
        try:
            while True:
                waiting.update(islice(numbered, max(0, _AHEAD * self._processes - len(waiting))))
                if not waiting:
                    return
                first = next(iter(waiting))
                try:
                    for number in [first] if suspects else waiting:
                        if number not in under_way:
                            under_way[number] = self._submit(waiting[number])
                    done = first if in_order or suspects else _any_done(under_way)
                    result = under_way.pop(done).result()
                except BrokenProcessPool:
                    self._end()
                    under_way = {number: future for number, future in under_way.items() if _came_through(future)}
                    if not suspects:
                        suspects = set(waiting) - set(under_way)
                        continue
                    done, result = first, self._died(waiting[first])
                del waiting[done]
                suspects.discard(done)
                yield result
        finally:
            for future in under_way.values():
                future.cancel()

    def _submit(self, task: Task) -> Future[Result]:
        if self._executor is None:  # not below: this starts a process that watches resources, and lets Ctrl-C in again
            context, initargs = multiprocessing.get_context("spawn"), (self._open_worker, os.getpid())
            self._executor = ProcessPoolExecutor(self._processes, context, _start, initargs)
        with uninterrupted():  # a worker is started here, which inherits that until it can deal with Ctrl-C
            return self._executor.submit(_do, task)

    def _end(self) -> None:
        if self._executor is not None:
            self._executor.shutdown(cancel_futures=True)
            self._executor = None

    def __enter__(self) -> Pool[Task, Result]:
        return self

    def __exit__(self, *error: object) -> None:
        """End the processes once what is under way is done."""
        self._end()
        if self._worker is not None:
            self._worker.close()
            self._worker = None


@dataclass(frozen=True)
class SentError:
    """An error as it can be sent to another process, through a pipe.

    Attributes:
        error: it, or what says the same in its stead.
        where: it was raised first, such as "a branch".
        traceback: of there.
    """

    error: BaseException
    where: str
    traceback: str

    @classmethod
    def of(
        cls,
        error: BaseException,
        where: str,
        *,
        sendable: type[BaseException] = BaseException,
        otherwise: type[Exception] = RuntimeError,
    ) -> SentError:
        """Make an error ready to be sent.

        Args:
            error: it.
            where: this process is what; of an error that was sent here, where it came from remains.
            sendable: what is sent as it is, if it pickles.
            otherwise: the type of what takes an error's place if not.
        """
        cause = error.__cause__
        place = cause.args if isinstance(cause, SentTraceback) else (where, "".join(format_exception(error)))
        with suppress(Exception):  # whatever its class does
            if isinstance(error, sendable) and type(pickle.loads(pickle.dumps(error))) is type(error):
                return cls(error, *place)
        return cls(otherwise(f"{type(error).__name__}: {error}"), *place)

    def reraise(self) -> NoReturn:
        """Raise the error here."""
        raise self.error from SentTraceback(self.where, self.traceback)


class SentTraceback(Exception):  # noqa: N818  (shown as the cause of an error, as `concurrent.futures` does)
    """Where in another process an error came from, as text: tracebacks can't be sent."""

    def __str__(self) -> str:
        where, text = self.args
        return f"in {where}:\n{text}"


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


def _refuse(task: Any) -> Any:
    what, fix = "the process that was at this died", "Is memory short? Use fewer --jobs."
    raise RobocasError(what, where=f"{task}"[:80], fix=fix)


def _came_through(future: Future[Any]) -> bool:
    """Whether a task was done before a process died."""
    return not future.cancelled() and not isinstance(future.exception(), BrokenProcessPool)


def _any_done(under_way: dict[int, Future[Any]]) -> int:
    done, _ = wait(under_way.values(), return_when=FIRST_COMPLETED)
    return next(number for number, future in under_way.items() if future in done)


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Hold Ctrl-C back for a moment."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@dataclass
class _Process:
    """What a process of the pool knows."""

    open_worker: Callable[[], Worker[Any, Any]] | None = None
    worker: Worker[Any, Any] | None = None
    interrupted: bool = False


_process = _Process()


def _start(open_worker: Callable[[], Worker[Any, Any]], parent: int) -> None:
    _process.interrupted = signal.SIGINT in signal.sigpending()  # while it was starting
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # but for tasks: what waits for one has nothing to interrupt
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    leave_with(parent)
    _process.open_worker = open_worker


def _do(task: Any) -> Any:
    if _process.interrupted:  # one task is always ahead, and can't be taken back
        raise KeyboardInterrupt
    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        if _process.worker is None:
            assert _process.open_worker is not None
            _process.worker = _process.open_worker()
        return _process.worker.do(task)
    except KeyboardInterrupt:
        _process.interrupted = True
        raise
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
