"""A progress bar on stderr that appears when there is something to do, so that an error is one line.

Where stderr is no terminal, such as a log, there is a line a minute instead.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

EVERY = 60.0  # s between two lines of a log


class Log:
    """Lines on stderr, no more than one a minute."""

    def __init__(self) -> None:
        self._begun = self._told = time.monotonic()

    def tell(self, text: str) -> None:
        """Write a line, with the minutes that it took so far, if the last one is a minute old."""
        now = time.monotonic()
        if now - self._told >= EVERY:
            self._told = now
            print(f"{text}, {(now - self._begun) / 60:.0f} min", file=sys.stderr, flush=True)


@dataclass(frozen=True)
class Bar:
    """A bar; its methods are callbacks of what does the work."""

    progress: Any
    description: str
    log: Log

    def start(self, count: int) -> None:
        """Show it, for so many."""
        self.progress.add_task(self.description, total=count)
        self.progress.start()

    def advance(self, *_: object) -> None:
        """One more is done."""
        self.progress.advance(self.progress.task_ids[0])
        self._tell()

    def at(self, done: int, count: int) -> None:
        """So many of all are done."""
        if not self.progress.task_ids:
            self.start(count)
        self.progress.update(self.progress.task_ids[0], completed=done)
        self._tell()

    def next_of(self, count: int) -> None:
        """One more of all is done."""
        if not self.progress.task_ids:
            self.start(count)
        self.advance()

    def _tell(self) -> None:
        if self.progress.disable:
            task = self.progress.tasks[0]
            self.log.tell(f"{self.description}: {task.completed:g} of {task.total:g}")


def columns() -> tuple[Any, ...]:
    """Columns of a bar: of what, how many, how long it has taken and will take."""
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    return (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )


@contextmanager
def bar(description: str, *, transient: bool = False) -> Iterator[Bar]:
    """Yield a bar, and end it; a transient one goes when it is done."""
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    progress = Progress(*columns(), console=console, transient=transient, disable=not console.is_interactive)
    try:
        yield Bar(progress, description, Log())
    finally:
        if progress.live.is_started:  # else it prints an empty line
            progress.stop()


def say(text: str) -> None:
    """Print a line on stdout."""
    from rich.console import Console

    Console().print(text, soft_wrap=True, highlight=False, markup=False)
