"""Print text on a terminal. Control characters in data are printed as escapes, so they cannot control the terminal."""

from __future__ import annotations

import json
import sys
from collections.abc import Collection, Iterable, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NoReturn

from robocas_ms3.core.text import escape_controls

if TYPE_CHECKING:
    from rich.console import Console

_PIPED_WIDTH = 200  # columns; 80 would wrap long names, and grep would not find them


def console(**options: Any) -> Console:
    """Return a rich console that prints control characters as escapes, and markup as plain text."""
    return _printable_console()(**{"markup": False, "emoji": False, "highlight": False, **options})


def table_console() -> Console:
    """Return a console for tables, as wide as the terminal; 200 columns if stdout is a pipe or a file."""
    found = console()
    return found if found.is_terminal else console(width=_PIPED_WIDTH)


def print_table(
    columns: Sequence[str], rows: Iterable[Sequence[object]], *, no_wrap: Collection[str] = (), **options: Any
) -> None:
    """Print a table; print nothing if it has no rows.

    Args:
        columns: titles of the columns.
        rows: cells of each row, text or a `rich.text.Text`.
        no_wrap: titles of the columns that are never wrapped, in addition to the first one.
        options: options of `rich.table.Table`.
    """
    from rich.table import Table
    from rich.text import Text

    table = Table(**options)
    for number, column in enumerate(columns):
        table.add_column(column, overflow="fold", no_wrap=number == 0 or column in no_wrap)
    for row in rows:
        table.add_row(*(cell if isinstance(cell, Text) else str(cell) for cell in row))
    if table.row_count:
        table_console().print(table)


def terminal_of_stderr() -> Console | None:
    """Return a console of stderr, or None if stderr is not an interactive terminal (even with FORCE_COLOR)."""
    if not sys.stderr.isatty():
        return None
    found = console(stderr=True)
    return found if found.is_interactive else None


def print_line(text: str) -> None:
    """Print one line on stdout."""
    print_text(escape_controls(text))


def print_text(text: str) -> None:
    """Print a text of several lines on stdout; line breaks inside data must be escaped by the caller."""
    console().print(text, soft_wrap=True)


def print_json(values: object) -> None:
    """Print values as indented JSON on stdout."""
    print_text(json.dumps(values, indent=2, ensure_ascii=False))


def print_stderr(text: str) -> None:
    """Print one line on stderr."""
    print(escape_controls(text), file=sys.stderr, flush=True)


@lru_cache(maxsize=1)
def _printable_console() -> type[Console]:
    from rich.console import Console  # takes 0.1 s, which `robocas --version` does not need
    from rich.segment import Segment
    from rich.text import Text

    class PrintableConsole(Console):
        def render_str(self, text: str, **options: Any) -> Text:
            return super().render_str(escape_controls(text, lines=True), **options)

        def render(self, *args: Any, **options: Any) -> Iterable[Segment]:
            for segment in super().render(*args, **options):  # also of a `Text` that the caller created
                yield segment if segment.control else Segment(escape_controls(segment.text, lines=True), segment.style)

        def on_broken_pipe(self) -> NoReturn:  # rich would end the process
            raise BrokenPipeError

    return PrintableConsole
