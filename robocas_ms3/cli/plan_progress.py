"""What `robocas plan run` shows: bars in a terminal, a line a minute in a log."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from robocas_ms3.cli.bars import Log
from robocas_ms3.errors import RobocasError
from robocas_ms3.plans.plan import Plan
from robocas_ms3.plans.status import status
from robocas_ms3.words import count_of

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
        console = Console(stderr=True)
        columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
        self._shown = Progress(*columns, TextColumn("{task.fields[left]}"), console=console)
        self._terminal, self._log = console.is_interactive, Log()
        self._left, self._looked = "", -_LOOK

    def __enter__(self) -> PlanProgress:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if self._shown.live.is_started:  # else it prints an empty line
            self._shown.stop()

    def at(self, counts: Sequence[int]) -> None:
        """So many episodes of each part are there."""
        self._estimate()
        if not self._terminal:
            self._log.tell(self._line(counts))
        else:
            self._draw(counts)

    def begin(self) -> None:
        """Say what is to be made."""
        if not self._terminal:
            _print(f"{self._out}: {count_of(self._total, 'episode')} of {count_of(len(self._plan.parts), 'part')}")

    def stage(self, text: str) -> None:
        """What is done now."""
        if self._shown.live.is_started:
            self._shown.console.print(text, highlight=False, markup=False)
        else:
            _print(text)

    def _draw(self, counts: Sequence[int]) -> None:
        rows = [(f"{part.name}", part.episodes, count) for part, count in zip(self._plan.parts, counts, strict=True)]
        rows = [*(rows if 1 < len(rows) <= _BARS else []), ("all", self._total, sum(counts))]
        if not self._shown.live.is_started:
            for name, total, count in rows:
                self._shown.add_task(name, total=total, completed=count, left="")
            self._shown.start()
        for bar, (_, _, count) in zip(self._shown.task_ids, rows, strict=True):
            self._shown.update(bar, completed=count)
        self._shown.update(self._shown.task_ids[-1], left=self._left)

    def _line(self, counts: Sequence[int]) -> str:
        parts = [
            f"{part.name} {count} of {part.episodes}"
            for part, count in zip(self._plan.parts, counts, strict=True)
            if 0 < count < part.episodes
        ]
        left = [self._left] if self._left else []
        return "; ".join([f"{sum(counts)} of {count_of(self._total, 'episode')}", *parts[:_BARS], *left])

    def _estimate(self) -> None:
        if time.monotonic() < self._looked + _LOOK:
            return
        self._looked = time.monotonic()
        with suppress(RobocasError, OSError):  # whoever does the work will say what is wrong with the folder
            found = status(self._out)
            if found.seconds_left is not None:
                rate = round(found.episodes_an_hour)
                self._left = f"{count_of(rate, 'episode')} an hour, {_span(found.seconds_left)} left"


def _span(seconds: float) -> str:
    """``40 s``, ``12 min``, ``3.5 h``, ``2.1 days``."""
    for unit, name, digits in ((86400.0, "days", 1), (3600.0, "h", 1), (60.0, "min", 0)):
        if seconds >= 2 * unit:
            return f"{seconds / unit:.{digits}f} {name}"
    return f"{seconds:.0f} s"


def _print(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
