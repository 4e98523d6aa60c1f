"""Text on the terminal. Control characters in data are shown as escapes: they never move the cursor or set colours."""

from __future__ import annotations

import json
import sys
from collections.abc import Collection, Iterable, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NoReturn

from robocas_ms3.core.text import escape_controls

if TYPE_CHECKING:
    from rich.console import Console

_PIPED_WIDTH = 200  # with 80 columns long names would be broken, and no search would find them


def console(**options: Any) -> Console:
    """Return a console that shows control characters as escapes and does not interpret markup."""
    return _printable_console()(**{"markup": False, "emoji": False, "highlight": False, **options})


def table_console() -> Console:
    """Return a console for tables: as wide as the terminal, or 200 columns in a pipe or a file."""
    made = console()
    return made if made.is_terminal else console(width=_PIPED_WIDTH)


def print_table(
    columns: Sequence[str], rows: Iterable[Sequence[object]], *, whole: Collection[str] = (), **options: Any
) -> None:
    """Print a table, unless it is empty.

    Args:
        columns: their heads; those in ``whole``, and the first one, are never broken.
        rows: a cell is text, or a renderable of rich.
        options: options of `rich.table.Table`.
    """
    from rich.table import Table
    from rich.text import Text

    table = Table(**options)
    for number, column in enumerate(columns):
        table.add_column(column, overflow="fold", no_wrap=number == 0 or column in whole)
    for row in rows:
        table.add_row(*(cell if isinstance(cell, Text) else str(cell) for cell in row))
    if table.row_count:
        table_console().print(table)


def terminal_of_stderr() -> Console | None:
    """Return a console of stderr if it is a terminal that can move its cursor; FORCE_COLOR does not count."""
    if not sys.stderr.isatty():
        return None
    made = console(stderr=True)
    return made if made.is_interactive else None


def print_line(text: str) -> None:
    """Print one line on stdout."""
    print_text(escape_controls(text))


def print_text(text: str) -> None:
    """Print lines on stdout. Data in them must have no line breaks of its own."""
    console().print(text, soft_wrap=True)


def print_json(values: object) -> None:
    print_text(json.dumps(values, indent=2, ensure_ascii=False))


def print_stderr(text: str) -> None:
    """Print one line on stderr."""
    print(escape_controls(text), file=sys.stderr, flush=True)


@lru_cache(maxsize=1)
def _printable_console() -> type[Console]:
    from rich.console import Console  # 0.1 s, for which `robocas --version` need not wait
    from rich.segment import Segment
    from rich.text import Text

    class PrintableConsole(Console):
        def render_str(self, text: str, **options: Any) -> Text:
            return super().render_str(escape_controls(text, lines=True), **options)

        def render(self, *args: Any, **options: Any) -> Iterable[Segment]:
            for one in super().render(*args, **options):  # of a `Text` that was made elsewhere
                yield one if one.control else Segment(escape_controls(one.text, lines=True), one.style)

        def on_broken_pipe(self) -> NoReturn:  # rich ends the process here
            raise BrokenPipeError

    return PrintableConsole
