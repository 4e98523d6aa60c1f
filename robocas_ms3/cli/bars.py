"""Progress of a command: a bar on a terminal, which appears with the first work so that an early error is one line.

If stderr is not a terminal, such as a log, there are lines instead: the first, one per minute, and the last.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

from robocas_ms3.cli.terminal import tell, terminal_of_stderr
from robocas_ms3.core.words import printable

EVERY = 60.0  # s between two lines of a log


class Log:
    """Lines on stderr: the first at once, then at most one per minute.

    Args:
        quiet: omit the first and the last line.
    """

    def __init__(self, *, quiet: bool = False) -> None:
        self._start = time.monotonic()
        self._next = self._start + (EVERY if quiet else 0.0)
        self._quiet = quiet
        self._text = ""

    def tell(self, text: str, about: str = "", *, last: bool = False) -> None:
        """Write a line if one is due.

        Args:
            text: the progress.
            about: speed and time left.
            last: write it now, unless the previous line was the same.
        """
        now = time.monotonic()
        due = not self._quiet and text != self._text if last else now >= self._next
        if due:
            self._next, self._text = now + EVERY, text
            after = f"after {span(now - self._start)}" if now - self._start >= 1 else ""
            tell(", ".join(filter(None, (text, about, after))))


class Bar:
    """Progress of one task; its methods are callbacks of the work.

    Args:
        description: name of the task.
        progress: a `rich.progress.Progress`; None if stderr is not a terminal.
        quiet: write no line to a log within the first minute.
    """

    def __init__(self, description: str, progress: Any, *, quiet: bool) -> None:
        self._description, self._progress, self._quiet = description, progress, quiet
        self._log: Log | None = None  # until there is something to do
        self._start, self._done, self._there, self._count, self._about = 0.0, 0, 0, 0, ""

    def start(self, count: int, there: int = 0) -> None:
        """Show the bar for ``count`` items, ``there`` of which were done before; nothing for 0 items."""
        if not count:
            return
        self._start, self._done, self._there, self._count = time.monotonic(), there, there, count
        self._log = Log(quiet=self._quiet)
        if self._progress:
            self._progress.add_task(self._description, total=count)
            self._progress.start()
        self._show()

    def advance(self, *_: object) -> None:
        """Count one more item as done."""
        self.at(self._done + 1, self._count)

    def at(self, done: int, count: int) -> None:
        """Set the number of items that are done. The first call starts a bar; its items do not count for the speed."""
        if not self._count:
            self.start(count, there=done)
        elif done != self._done:
            self._done = done
            self._show()

    def next_of(self, count: int) -> None:
        """Count one more item of ``count`` as done."""
        self.at(self._done + 1, count)

    def note(self, text: str) -> None:
        """Write a line above the bar."""
        if self._progress:
            self._progress.console.print(printable(text), soft_wrap=True)
        else:
            tell(text)

    def stop(self) -> None:
        """Remove the bar, or write the last line."""
        self._show(last=True)
        if self._progress and self._log is not None:  # else it prints an empty line
            self._progress.stop()

    def _show(self, *, last: bool = False) -> None:
        if self._log is None:
            return
        if not last:  # the speed is known when an item is done
            self._about = speed(self._done, self._count, self._there, time.monotonic() - self._start)
        if self._progress:
            self._progress.update(self._progress.task_ids[0], completed=self._done, about=self._about)
        else:
            self._log.tell(f"{self._description}: {self._done} of {self._count}", self._about, last=last)


def speed(done: float, count: float, there: float, seconds: float) -> str:
    """Return speed and time left, such as ``1.5 s each, 7 min left``; empty before the first new item is done.

    Args:
        done: items that are done.
        count: all items.
        there: items that were done before.
        seconds: time that the others took.
    """
    if done <= there or seconds <= 0:
        return ""
    each = seconds / (done - there)
    rate = f"{each:.1f} s each" if each >= 1 else f"{1 / each:.1f} a second"
    return rate + (f", {span(each * (count - done))} left" if done < count else "")


def span(seconds: float) -> str:
    """Format a duration: ``45 s``, ``6 min``, ``3 h 20 min``, ``2.1 days``."""
    minutes = round(seconds / 60)
    if seconds < 59.5:
        return f"{seconds:.0f} s"
    if minutes < 60:
        return f"{minutes} min"
    return f"{minutes // 60} h {minutes % 60} min" if minutes < 2 * 24 * 60 else f"{seconds / 86400:.1f} days"


def columns() -> tuple[Any, ...]:
    """Return the columns of a bar: description, bar, count, time elapsed, speed and time left."""
    from rich.progress import BarColumn, MofNCompleteColumn, ProgressColumn, TextColumn, TimeElapsedColumn
    from rich.text import Text

    class Speed(ProgressColumn):
        def render(self, task: Any) -> Text:
            about = task.fields.get("about")
            if about is None:
                about = speed(task.completed, task.total or 0, 0, task.elapsed or 0.0)
            return Text(about, style="progress.remaining")

    return (
        TextColumn("{task.description}", markup=False),
        BarColumn(20),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        Speed(),
    )


@contextmanager
def bar(description: str, *, transient: bool = False) -> Iterator[Bar]:
    """Yield a progress bar.

    Args:
        description: name of the task.
        transient: remove the bar at the end, and write nothing to a log within the first minute.
    """
    shown = Bar(description, _progress(transient), quiet=transient)
    try:
        yield shown
    finally:
        shown.stop()


@contextmanager
def working(text: str) -> Iterator[None]:
    """Show a spinner on a terminal, for work of unknown length."""
    terminal = terminal_of_stderr()
    with terminal.status(text) if terminal else nullcontext():
        yield


def _progress(transient: bool) -> Any:
    """Return a progress display of rich; None if stderr is not a terminal."""
    terminal = terminal_of_stderr()
    if terminal is None:
        return None
    from rich.progress import Progress

    beside = sys.stdout.isatty()  # else what goes into a file or a pipe would be shown here instead
    return Progress(*columns(), console=terminal, transient=transient, redirect_stdout=beside)
