"""Tables on stdout."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console

_PIPED_WIDTH = 200  # of a terminal's 80 columns names would be broken, and no search would find them


def table_console() -> Console:
    """A console as wide as the terminal; into a pipe or a file as wide as our tables need."""
    from rich.console import Console

    console = Console()
    return console if console.is_terminal else Console(width=_PIPED_WIDTH)
