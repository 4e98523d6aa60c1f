"""How far a command is: a bar on a terminal that appears when there is something to do, so that an error is one line.

Where stderr is no terminal, such as a log, there are lines instead: the first, one a minute, and the last.
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
    """Lines on stderr, the first at once, then no more than one a minute.

    Args:
        quiet: leave out the first and the last.
    """

    def __init__(self, *, quiet: bool = False) -> None:
        self._begun = time.monotonic()
        self._next = self._begun + (EVERY if quiet else 0.0)
        self._quiet = quiet
        self._text = ""

    def tell(self, text: str, about: str = "", *, last: bool = False) -> None:
        """Write a line if it is time for one.

        Args:
            text: how far it is.
            about: how fast it goes.
            last: write it now, unless the last line was just this.
        """
        now = time.monotonic()
        due = not self._quiet and text != self._text if last else now >= self._next
        if due:
            self._next, self._text = now + EVERY, text
            after = f"after {span(now - self._begun)}" if now - self._begun >= 1 else ""
            tell(", ".join(filter(None, (text, about, after))))


class Bar:
    """How far one thing is; its methods are callbacks of what does the work.

    Args:
        description: of what.
        progress: rich's; none where stderr is no terminal.
        quiet: say nothing in a log of what is over within a minute.
    """

    def __init__(self, description: str, progress: Any, *, quiet: bool) -> None:
        self._description, self._progress, self._quiet = description, progress, quiet
        self._log: Log | None = None  # until there is something to do
        self._begun, self._done, self._there, self._count, self._about = 0.0, 0, 0, 0, ""

    def start(self, count: int, there: int = 0) -> None:
        """Show it, for so many, of which so many were there before; nothing where there is nothing to do."""
        if not count:
            return
        self._begun, self._done, self._there, self._count = time.monotonic(), there, there, count
        self._log = Log(quiet=self._quiet)
        if self._progress:
            self._progress.add_task(self._description, total=count)
            self._progress.start()
        self._show()

    def advance(self, *_: object) -> None:
        """One more is done."""
        self.at(self._done + 1, self._count)

    def at(self, done: int, count: int) -> None:
        """So many of all are done. Where it was not started, it starts with these: how long they took is not known."""
        if not self._count:
            self.start(count, there=done)
        elif done != self._done:
            self._done = done
            self._show()

    def next_of(self, count: int) -> None:
        """One more of all is done."""
        self.at(self._done + 1, count)

    def note(self, text: str) -> None:
        """Write a line above it."""
        if self._progress:
            self._progress.console.print(printable(text), soft_wrap=True)
        else:
            tell(text)

    def stop(self) -> None:
        """End it, with how far it came."""
        self._show(last=True)
        if self._progress and self._log is not None:  # else it prints an empty line
            self._progress.stop()

    def _show(self, *, last: bool = False) -> None:
        if self._log is None:
            return
        if not last:  # how fast it goes is known at the moments when one is done
            self._about = speed(self._done, self._count, self._there, time.monotonic() - self._begun)
        if self._progress:
            self._progress.update(self._progress.task_ids[0], completed=self._done, about=self._about)
        else:
            self._log.tell(f"{self._description}: {self._done} of {self._count}", self._about, last=last)


def speed(done: float, count: float, there: float, seconds: float) -> str:
    """How fast it goes and how long it will take: ``1.5 s each, 7 min left``; nothing before one more is done.

    Args:
        done: so many are done.
        count: of so many.
        there: so many of them had been done before.
        seconds: what the others took.
    """
    if done <= there or seconds <= 0:
        return ""
    each = seconds / (done - there)
    rate = f"{each:.1f} s each" if each >= 1 else f"{1 / each:.1f} a second"
    return rate + (f", {span(each * (count - done))} left" if done < count else "")


def span(seconds: float) -> str:
    """``45 s``, ``6 min``, ``3 h 20 min``, ``2.1 days``."""
    minutes = round(seconds / 60)
    if seconds < 59.5:
        return f"{seconds:.0f} s"
    if minutes < 60:
        return f"{minutes} min"
    return f"{minutes // 60} h {minutes % 60} min" if minutes < 2 * 24 * 60 else f"{seconds / 86400:.1f} days"


def columns() -> tuple[Any, ...]:
    """Columns of a bar: of what, how many, how long it has taken, how fast it goes and how long it will take."""
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
    """Yield a bar, and end it.

    Args:
        description: of what.
        transient: it goes when it is done; in a log there is nothing of it that is over within a minute.
    """
    shown = Bar(description, _progress(transient), quiet=transient)
    try:
        yield shown
    finally:
        shown.stop()


@contextmanager
def working(text: str) -> Iterator[None]:
    """Show on a terminal that something is going on, of which nobody knows how far it is."""
    terminal = terminal_of_stderr()
    with terminal.status(text) if terminal else nullcontext():
        yield


def _progress(transient: bool) -> Any:
    """Of rich; none where stderr is no terminal."""
    terminal = terminal_of_stderr()
    if terminal is None:
        return None
    from rich.progress import Progress

    beside = sys.stdout.isatty()  # else what goes into a file or a pipe would be shown here instead
    return Progress(*columns(), console=terminal, transient=transient, redirect_stdout=beside)
