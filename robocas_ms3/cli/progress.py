"""Progress of a command: a bar on a terminal, which appears with the first work so that an early error is one line.

If stderr is not a terminal, such as a log, there are lines instead: the first, one per minute, and the last.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from typing import TYPE_CHECKING, Any

from robocas_ms3.cli.terminal import print_stderr, terminal_of_stderr
from robocas_ms3.core.text import escape_controls, format_count

if TYPE_CHECKING:
    from robocas_ms3.plans.status import Status

EVERY = 60.0  # s between two lines of a log
_PART_BARS = 12  # parts of a plan; more of them have one bar


class ProgressDisplay:
    """Rows of a progress display, or lines of a log if stderr is not a terminal.

    Args:
        transient: remove the display at the end, and write nothing to a log within the first minute.
    """

    def __init__(self, *, transient: bool = False) -> None:
        self.bars = _rich_progress(transient)  # None: a log
        self._quiet = transient
        self._start = self._next = time.monotonic()
        self._text = self._about = self._written = ""

    def show(self, rows: Sequence[tuple[str, int, int]], text: str, about: str) -> None:
        """Show the progress: the first call starts the display.

        Args:
            rows: name, count and number done of each bar.
            text: the progress, for a log.
            about: speed and time left.
        """
        first, self._text, self._about = not self._text, text, about
        now = time.monotonic()
        if first:
            self._start, self._next = now, now + (EVERY if self._quiet else 0.0)
        if self.bars is None:
            if now >= self._next:
                self._write_line()
            return
        if first:
            for name, count, _ in rows:
                self.bars.add_task(name, total=count, about="")
            self.bars.start()
        for bar, (_, _, done) in zip(self.bars.task_ids, rows, strict=True):
            self.bars.update(bar, completed=done)
        self.bars.update(self.bars.task_ids[-1], about=about)

    def note(self, text: str) -> None:
        if self.bars is None:
            print_stderr(text)
        else:
            self.bars.console.print(escape_controls(text), soft_wrap=True)

    def flush(self) -> None:
        """Write the last progress to a log."""
        if self.bars is None and self._text != self._written and not self._quiet:
            self._write_line()

    def close(self) -> None:
        """Remove the bars, or write the last line."""
        self.flush()
        if self.bars is not None and self._text:  # otherwise it prints an empty line
            self.bars.stop()

    def _write_line(self) -> None:
        now = time.monotonic()
        self._next, self._written = now + EVERY, self._text
        after = f"after {format_duration(now - self._start)}" if now - self._start >= 1 else ""
        print_stderr(", ".join(filter(None, (self._text, self._about, after))))


class ProgressBar:
    """Progress of one task, a context manager; its methods are callbacks of the work.

    Args:
        description: name of the task.
        transient: remove the bar at the end, and write nothing to a log within the first minute.
    """

    def __init__(self, description: str, *, transient: bool = False) -> None:
        self._description, self._display = description, ProgressDisplay(transient=transient)
        self.note, self.close = self._display.note, self._display.close
        self._start, self._done, self._there, self._count = 0.0, 0, 0, 0

    def __enter__(self) -> ProgressBar:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def start(self, count: int, there: int = 0) -> None:
        """Show the bar for ``count`` items, ``there`` of which were done before; nothing for 0 items."""
        if count:
            self._start, self._there, self._count = time.monotonic(), there, count
            self._show(there)

    def advance(self, *_: object) -> None:
        """Count one more item as done."""
        self.update(self._done + 1, self._count)

    def at(self, done: int, count: int) -> None:
        """Set the number of items that are done. The first call starts a bar; its items do not count for the speed."""
        if not self._count:
            self.start(count, there=done)
        elif done != self._done:
            self._show(done)

    def _show(self, done: int) -> None:
        self._done = done
        about = format_speed(done, self._count, self._there, time.monotonic() - self._start)
        text = f"{self._description}: {done} of {self._count}"
        self._display.show([(self._description, self._count, done)], text, about)


def show_plan(display: ProgressDisplay, status: Status) -> None:
    """Show the status of a plan: a bar for each part, and one for all."""
    rows = [(part.name, part.requested, part.done) for part in status.parts]
    total, done = sum(part.requested for part in status.parts), sum(part.done for part in status.parts)
    parts = [f"{name} {done} of {requested}" for name, requested, done in rows if 0 < done < requested]
    text = f"{done} of {format_count(total, 'episode')}"
    text += f" ({'; '.join(parts[:_PART_BARS])})" if len(rows) > 1 and parts else ""
    about = ""
    if status.seconds_left is not None:
        rate = format_count(round(status.episodes_per_hour), "episode")
        about = f"{rate} per hour, {format_duration(status.seconds_left)} left"
    display.show([*(rows if 1 < len(rows) <= _PART_BARS else []), ("all", total, done)], text, about)


def format_speed(done: float, count: float, there: float, seconds: float) -> str:
    """Return ``1.5 s each, 7 min left`` or the like; ``there`` items were done before these seconds."""
    if done <= there or seconds <= 0:
        return ""
    each = seconds / (done - there)
    rate = f"{each:.1f} s each" if each >= 1 else f"{1 / each:.1f} a second"
    return rate + (f", {format_duration(each * (count - done))} left" if done < count else "")


def format_duration(seconds: float) -> str:
    """Format a duration: ``45 s``, ``6 min``, ``3 h 20 min``, ``2.1 days``."""
    minutes = round(seconds / 60)
    if seconds < 59.5:
        return f"{seconds:.0f} s"
    if minutes < 60:
        return f"{minutes} min"
    return f"{minutes // 60} h {minutes % 60} min" if minutes < 2 * 24 * 60 else f"{seconds / 86400:.1f} days"


@contextmanager
def spinner(text: str) -> Iterator[None]:
    terminal = terminal_of_stderr()
    with terminal.status(text) if terminal else nullcontext():
        yield


def _rich_progress(transient: bool) -> Any:
    terminal = terminal_of_stderr()
    if terminal is None:
        return None
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(20),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[about]}", style="progress.remaining"),
    )
    redirects = sys.stdout.isatty()  # otherwise the content of a file or a pipe would be shown here instead
    return Progress(*columns, console=terminal, transient=transient, redirect_stdout=redirects)
