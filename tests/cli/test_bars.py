"""Bars show on a terminal; elsewhere a line a minute does, and nothing at all of what is over sooner."""

import os
import subprocess
import sys

import pytest

from robocas_ms3.cli import bars

SCRIPT = """
from robocas_ms3.cli.bars import bar, say
with bar("counting") as shown:
    shown.start(2)
    shown.advance()
    shown.at(2, 2)
with bar("replaying", transient=True) as shown:
    shown.next_of(3)
    shown.next_of(3)
say("done")
"""


def run(**kwargs):
    environment = {k: v for k, v in os.environ.items() if k not in ("FORCE_COLOR", "TTY_COMPATIBLE", "TTY_INTERACTIVE")}
    command = [sys.executable, "-c", SCRIPT]
    return subprocess.run(command, check=True, env={**environment, "TERM": "xterm"}, timeout=60, **kwargs)


def test_where_stderr_is_no_terminal():
    done = run(capture_output=True, text=True)
    assert (done.stdout, done.stderr) == ("done\n", "")


@pytest.mark.skipif(not hasattr(os, "openpty"), reason="needs a pseudo-terminal")
def test_on_a_terminal():
    terminal, end = os.openpty()
    try:
        done = run(stdout=subprocess.PIPE, stderr=end, text=True)
        os.close(end)
        shown = os.read(terminal, 1 << 16).decode()
    finally:
        os.close(terminal)
    assert done.stdout == "done\n"
    assert "counting" in shown
    assert "2/2" in shown
    assert "replaying" in shown
    assert "2/3" in shown


def test_a_line_a_minute_in_a_log(monkeypatch, capsys):
    now = [0.0]
    monkeypatch.setattr(bars.time, "monotonic", lambda: now[0])
    with bars.bar("episodes") as shown:
        for done in range(1, 301):
            now[0] += 1.5
            shown.at(done, 300)
    lines = capsys.readouterr().err.splitlines()
    assert lines[:2] == ["episodes: 40 of 300, 1 min", "episodes: 80 of 300, 2 min"]
    assert len(lines) == 7
