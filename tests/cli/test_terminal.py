"""Control characters in data are printed as escapes by all commands."""

import io
import subprocess
import sys

import pytest
from rich.table import Table
from rich.text import Text

from robocas_ms3.cli import main as cli
from robocas_ms3.cli import progress
from robocas_ms3.cli.list import List
from robocas_ms3.cli.terminal import console, print_line, print_stderr, print_text
from robocas_ms3.core.documents import DocumentError
from robocas_ms3.core.errors import RobocasError

HOSTILE = "a\x1b[2J\x9b31m\u202eb\n\rc[bold]d[/e] :smile:"
SHOWN = "a\\u001b[2J\\u009b31m\\u202eb"


def controls(text: str) -> set[str]:
    """Return the unprintable characters of a text, except line breaks."""
    return {character for character in text if not character.isprintable()} - {"\n"}


def test_print_line_prints_one_line(capsys):
    print_line(HOSTILE)
    print_stderr(HOSTILE)
    shown = capsys.readouterr()
    assert shown.out == shown.err == f"{SHOWN}\\u000a\\u000dc[bold]d[/e] :smile:\n"
    print_text(f"one\n{SHOWN}\x1b\ntwo")
    assert capsys.readouterr().out == f"one\n{SHOWN}\\u001b\ntwo\n"


def test_closed_pipe():
    class Closed(io.StringIO):
        def write(self, _text):
            raise BrokenPipeError

    with pytest.raises(BrokenPipeError):
        console(file=Closed()).print("a line")


def test_tables():
    file = io.StringIO()
    table = Table(HOSTILE, title=HOSTILE)
    table.add_row(HOSTILE)
    table.add_row(Text(HOSTILE))
    console(file=file, width=200).print(table, HOSTILE, Text(HOSTILE))
    assert not controls(file.getvalue())
    assert file.getvalue().count(SHOWN) == 6
    assert file.getvalue().count("c[bold]d[/e] :smile:") == 6


def test_progress_bars(monkeypatch):
    file = io.StringIO()
    made = console(file=file, force_terminal=True, width=200, color_system=None)
    monkeypatch.setattr(progress, "terminal_of_stderr", lambda: made)
    with progress.ProgressBar(HOSTILE) as bar:
        bar.start(2)
        bar.add_note(HOSTILE)
        bar.advance()
    assert "\x1b[2J" not in file.getvalue()
    assert not controls(file.getvalue()) - {"\x1b", "\r"}  # those that draw the bar
    assert SHOWN in file.getvalue()


@pytest.mark.parametrize("error", [RobocasError(HOSTILE, where=HOSTILE, found=HOSTILE), DocumentError(HOSTILE)])
def test_error_is_one_line(monkeypatch, capsys, error):
    def main(cfg: List) -> int:
        raise error

    monkeypatch.setattr("robocas_ms3.cli.list.main", main)
    assert cli.run(["list"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert not controls(line)
    assert SHOWN in line


def test_tracebacks():
    script = (
        "import threading; from robocas_ms3.core.text import escape_tracebacks; escape_tracebacks()\n"
        f"def fail(*_): raise ValueError({HOSTILE!r})\n"
        "threading.Thread(target=fail).start(); type('Freed', (), {'__del__': fail})(); fail()"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.stderr.count(f"ValueError: {SHOWN}") == 3
    assert not controls(done.stderr)
