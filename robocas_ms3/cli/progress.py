"""Progress of a command on stderr: bars on a terminal, lines in a log (first, one per minute, last).

The display starts with the first item, so an error before it is the only output.
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
    from robocas_ms3.plans.status import PlanStatus

LOG_INTERVAL = 60.0  # s between two lines of a log
_MAX_PART_BARS = 12  # a plan with more parts has one bar


class ProgressDisplay:
    """Progress bars on a terminal, or lines of a log if stderr is not a terminal.

    Args:
        transient: whether to remove the bars at the end, and to write nothing to a log in the first minute.
    """

    def __init__(self, *, transient: bool = False) -> None:
        self.bars = _rich_progress(transient)  # None: stderr is a log
        self._quiet = transient
        self._start = self._next = time.monotonic()
        self._text = self._speed = self._written = ""

    def show(self, bars: Sequence[tuple[str, int, int]], text: str, speed: str) -> None:
        """Show the progress; the first call starts the display.

        Args:
            bars: name, total and number done of each bar.
            text: the progress as text, which a log shows instead of the bars.
            speed: text with the speed and the time left.
        """
        first, self._text, self._speed = not self._text, text, speed
        now = time.monotonic()
        if first:
            self._start, self._next = now, now + (LOG_INTERVAL if self._quiet else 0.0)
        if self.bars is None:
            if now >= self._next:
                self._write_line()
            return
        if first:
            for name, total, _ in bars:
                self.bars.add_task(name, total=total, speed="")
            self.bars.start()
        for bar, (_, _, done) in zip(self.bars.task_ids, bars, strict=True):
            self.bars.update(bar, completed=done)
        self.bars.update(self.bars.task_ids[-1], speed=speed)

    def add_note(self, text: str) -> None:
        """Print a line above the bars, or into the log."""
        if self.bars is None:
            print_stderr(text)
        else:
            self.bars.console.print(escape_controls(text), soft_wrap=True)

    def flush(self) -> None:
        """Write the current progress to a log."""
        if self.bars is None and self._text != self._written and not self._quiet:
            self._write_line()

    def close(self) -> None:
        """Stop the bars, or write the last line of a log."""
        self.flush()
        if self.bars is not None and self._text:  # stopping bars that never started prints an empty line
            self.bars.stop()

    def _write_line(self) -> None:
        now = time.monotonic()
        self._next, self._written = now + LOG_INTERVAL, self._text
        elapsed = f"{format_duration(now - self._start)} elapsed" if now - self._start >= 1 else ""
        print_stderr(", ".join(filter(None, (self._text, self._speed, elapsed))))


class ProgressBar:
    """Progress bar of one task, a context manager; its methods serve as callbacks.

    Args:
        description: label of the bar, such as "episodes recorded".
        transient: whether to remove the bar at the end, and to write nothing to a log in the first minute.
    """

    def __init__(self, description: str, *, transient: bool = False) -> None:
        self._description, self._display = description, ProgressDisplay(transient=transient)
        self.add_note, self.close = self._display.add_note, self._display.close
        self._start, self._done, self._initial, self._total = 0.0, 0, 0, 0

    def __enter__(self) -> ProgressBar:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def start(self, total: int, initial: int = 0) -> None:
        """Show the bar for ``total`` items, of which ``initial`` are done already; show nothing if ``total`` is 0."""
        if total:
            self._start, self._initial, self._total = time.monotonic(), initial, total
            self._show(initial)

    def advance(self, *_: object) -> None:
        """Count one more item as done."""
        self.update(self._done + 1, self._total)

    def update(self, done: int, total: int) -> None:
        """Set the number of items done.

        The first call starts the bar. The items of the first call do not count for the speed.
        """
        if not self._total:
            self.start(total, initial=done)
        elif done != self._done:
            self._show(done)

    def _show(self, done: int) -> None:
        self._done = done
        speed = format_speed(done, self._total, self._initial, time.monotonic() - self._start)
        text = f"{self._description}: {done}/{self._total}"
        self._display.show([(self._description, self._total, done)], text, speed)


def show_plan(display: ProgressDisplay, status: PlanStatus) -> None:
    """Show the status of a plan: one bar per plan part, and one bar for the whole plan."""
    bars = [(part.name, part.requested, part.done) for part in status.parts]
    total, done = sum(part.requested for part in status.parts), sum(part.done for part in status.parts)
    parts = [f"{name} {done}/{requested}" for name, requested, done in bars if 0 < done < requested]
    text = f"episodes: {done}/{total}"
    text += f" ({'; '.join(parts[:_MAX_PART_BARS])})" if len(bars) > 1 and parts else ""
    speed = ""
    if status.seconds_left is not None:
        rate = format_count(round(status.episodes_per_hour), "episode")
        speed = f"{rate}/h, {format_duration(status.seconds_left)} left"
    display.show([*(bars if 1 < len(bars) <= _MAX_PART_BARS else []), ("all", total, done)], text, speed)


def format_speed(done: float, total: float, initial: float, seconds: float) -> str:
    """Format the speed and the time left, such as ``1.5 s/it, 7 min left``.

    Args:
        done: number of items done, including the initial ones.
        total: number of all items.
        initial: number of items that were done before the time began.
        seconds: elapsed time.
    """
    if done <= initial or seconds <= 0:
        return ""
    per_item = seconds / (done - initial)
    rate = f"{per_item:.1f} s/it" if per_item >= 1 else f"{1 / per_item:.1f} it/s"
    return rate + (f", {format_duration(per_item * (total - done))} left" if done < total else "")


def format_duration(seconds: float) -> str:
    """Format a duration in s, such as ``45 s``, ``6 min``, ``3 h 20 min`` or ``2.1 days``."""
    minutes = round(seconds / 60)
    if seconds < 59.5:
        return f"{seconds:.0f} s"
    if minutes < 60:
        return f"{minutes} min"
    return f"{minutes // 60} h {minutes % 60} min" if minutes < 2 * 24 * 60 else f"{seconds / 86400:.1f} days"


@contextmanager
def spinner(text: str) -> Iterator[None]:
    """Show a text with a spinner on a terminal, and nothing in a log."""
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
        TextColumn("{task.fields[speed]}", style="progress.remaining"),
    )
    redirects = sys.stdout.isatty()  # otherwise stdout is a file or a pipe, and must not be redirected to the terminal
    return Progress(*columns, console=terminal, transient=transient, redirect_stdout=redirects)
