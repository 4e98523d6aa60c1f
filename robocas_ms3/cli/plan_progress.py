"""What `robocas plan run` shows: bars in a terminal, a line a minute in a log."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from robocas_ms3.cli.bars import Log, span
from robocas_ms3.cli.terminal import tell, terminal_of_stderr
from robocas_ms3.core.errors import RobocasError
from robocas_ms3.core.words import count_of, printable
from robocas_ms3.plans.plan import Plan
from robocas_ms3.plans.status import status

_BARS = 12  # parts; of more there is one bar for all
_LOOK = 5.0  # s between two estimates, which read the folder


class PlanProgress:
    """Shows how far a plan is; a context manager, whose methods are callbacks of `run_plan`.

    Args:
        plan: it.
        out: its folder.
    """

    def __init__(self, plan: Plan, out: Path) -> None:
        self._plan, self._out = plan, out
        self._total = sum(part.episodes for part in plan.parts)
        self._log = Log()
        self._text = self._speed = ""
        self._looked = -_LOOK
        terminal = terminal_of_stderr()
        columns = (
            TextColumn("{task.description}", markup=False),
            BarColumn(20),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
        )
        beside = sys.stdout.isatty()  # else what goes into a file or a pipe would be shown here instead
        about = TextColumn("{task.fields[about]}")
        self._shown = Progress(*columns, about, console=terminal, redirect_stdout=beside) if terminal else None

    def __enter__(self) -> PlanProgress:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if self._shown is None:
            if self._text:
                self._log.tell(self._text, last=True)
        elif self._shown.live.is_started:  # else it prints an empty line
            self._shown.stop()

    def at(self, counts: Sequence[int]) -> None:
        """So many episodes of each part are there."""
        self._estimate()
        if self._shown is None:
            self._text = self._line(counts)
            self._log.tell(self._text, self._speed)
        else:
            self._draw(self._shown, counts)

    def note(self, text: str) -> None:
        """Say what is done now."""
        if self._shown is None:
            self._log.tell(self._text, last=True)  # how far it was when this began
            tell(text)
        else:
            self._shown.console.print(printable(text), soft_wrap=True)

    def _draw(self, shown: Progress, counts: Sequence[int]) -> None:
        rows = [(f"{part.name}", part.episodes, count) for part, count in zip(self._plan.parts, counts, strict=True)]
        rows = [*(rows if 1 < len(rows) <= _BARS else []), ("all", self._total, sum(counts))]
        if not shown.task_ids:
            for name, total, count in rows:
                shown.add_task(name, total=total, completed=count, about="")
            shown.start()
        for bar, (_, _, count) in zip(shown.task_ids, rows, strict=True):
            shown.update(bar, completed=count)
        shown.update(shown.task_ids[-1], about=self._speed)

    def _line(self, counts: Sequence[int]) -> str:
        """How far all is, and the parts that are under way."""
        parts = [
            f"{part.name} {count} of {part.episodes}"
            for part, count in zip(self._plan.parts, counts, strict=True)
            if 0 < count < part.episodes
        ]
        said = f"{sum(counts)} of {count_of(self._total, 'episode')}"
        return f"{said} ({'; '.join(parts[:_BARS])})" if len(counts) > 1 and parts else said

    def _estimate(self) -> None:
        if time.monotonic() < self._looked + _LOOK:
            return
        self._looked = time.monotonic()
        with suppress(RobocasError, OSError):  # whoever does the work will say what is wrong with the folder
            found = status(self._out)
            if found.seconds_left is not None:
                rate = count_of(round(found.episodes_an_hour), "episode")
                self._speed = f"{rate} an hour, {span(found.seconds_left)} left"
