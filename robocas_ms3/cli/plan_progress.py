"""Progress of `robocas plan run`: bars in a terminal, a line per minute in a log."""

from __future__ import annotations

import sys
from types import TracebackType

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from robocas_ms3.cli.bars import Log, span
from robocas_ms3.cli.terminal import tell, terminal_of_stderr
from robocas_ms3.core.words import count_of, printable
from robocas_ms3.plans.plan import Plan
from robocas_ms3.plans.status import Status

_BARS = 12  # parts; more of them have one bar


class PlanProgress:
    """Shows the progress of a plan; a context manager, whose methods are callbacks of `run_plan`.

    Args:
        plan: the plan.
    """

    def __init__(self, plan: Plan) -> None:
        self._total = sum(part.episodes for part in plan.parts)
        self._log = Log()
        self._text = ""
        terminal = terminal_of_stderr()
        columns = (
            TextColumn("{task.description}", markup=False),
            BarColumn(20),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("{task.fields[about]}"),
        )
        redirects = sys.stdout.isatty()  # otherwise the content of a file or a pipe would be shown here instead
        self._bars = Progress(*columns, console=terminal, redirect_stdout=redirects) if terminal else None

    def __enter__(self) -> PlanProgress:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if self._bars is None:
            if self._text:
                self._log.tell(self._text, last=True)
        elif self._bars.live.is_started:  # otherwise it prints an empty line
            self._bars.stop()

    def show(self, status: Status) -> None:
        """Show a status."""
        speed = ""
        if status.seconds_left is not None:
            rate = count_of(round(status.episodes_an_hour), "episode")
            speed = f"{rate} per hour, {span(status.seconds_left)} left"
        if self._bars is None:
            self._text = self._line(status)
            self._log.tell(self._text, speed)
        else:
            self._draw(self._bars, status, speed)

    def note(self, text: str) -> None:
        """Show what is done now."""
        if self._bars is None:
            self._log.tell(self._text, last=True)  # the progress when this began
            tell(text)
        else:
            self._bars.console.print(printable(text), soft_wrap=True)

    def _draw(self, bars: Progress, status: Status, speed: str) -> None:
        rows = [(part.name, part.wanted, part.done) for part in status.parts]
        rows = [*(rows if 1 < len(rows) <= _BARS else []), ("all", self._total, sum(done for _, _, done in rows))]
        if not bars.task_ids:
            for name, total, done in rows:
                bars.add_task(name, total=total, completed=done, about="")
            bars.start()
        for bar, (_, _, done) in zip(bars.task_ids, rows, strict=True):
            bars.update(bar, completed=done)
        bars.update(bars.task_ids[-1], about=speed)

    def _line(self, status: Status) -> str:
        """Return the progress of all, and of the parts that are under way."""
        parts = [f"{part.name} {part.done} of {part.wanted}" for part in status.parts if 0 < part.done < part.wanted]
        text = f"{sum(part.done for part in status.parts)} of {count_of(self._total, 'episode')}"
        return f"{text} ({'; '.join(parts[:_BARS])})" if len(status.parts) > 1 and parts else text
