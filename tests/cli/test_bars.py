"""Bars show on a terminal; elsewhere the first line, one a minute and the last do, plain and with the same numbers."""

import os
import re
import subprocess
import sys

import pytest

from robocas_ms3.cli import bars

SCRIPT = """
from robocas_ms3.cli.bars import bar, working
from robocas_ms3.cli.terminal import say
with working("looking about"):
    pass
with bar("counted") as shown:
    shown.start(2)
    shown.advance()
    shown.note("[1] is :odd: " + 90 * "x")
    say("one")
    shown.at(2, 2)
with bar("replayed", transient=True) as shown:
    shown.next_of(3)
    shown.next_of(3)
with bar("none") as shown:
    shown.start(0)
with bar("never begun") as shown:
    pass
say("done")
"""
FORCED = ("FORCE_COLOR", "TTY_COMPATIBLE", "TTY_INTERACTIVE")


def run(*, forced="", **kwargs):
    environment = {k: v for k, v in os.environ.items() if k not in FORCED} | ({forced: "1"} if forced else {})
    command = [sys.executable, "-c", SCRIPT]
    return subprocess.run(command, check=True, env={**environment, "TERM": "xterm"}, timeout=60, **kwargs)


@pytest.mark.parametrize("forced", ["", *FORCED])
def test_where_stderr_is_no_terminal(forced):
    done = run(forced=forced, capture_output=True)
    assert done.stdout == b"one\ndone\n"
    noted = b"[1] is :odd: " + 90 * b"x"
    assert done.stderr.splitlines() == [b"counted: 0 of 2", noted, done.stderr.splitlines()[-1]]
    assert re.fullmatch(rb"counted: 2 of 2, [0-9.]+ a second", done.stderr.splitlines()[-1])
    assert b"\r" not in done.stderr and b"\x1b" not in done.stderr


@pytest.mark.skipif(not hasattr(os, "openpty"), reason="needs a pseudo-terminal")
def test_on_a_terminal():
    terminal, end = os.openpty()
    try:
        done = run(stdout=subprocess.PIPE, stderr=end, text=True)
        os.close(end)
        shown = os.read(terminal, 1 << 16).decode()
    finally:
        os.close(terminal)
    assert done.stdout == "one\ndone\n"  # not among the bars, which are shown elsewhere
    for text in ("looking about", "counted", "2/2", "a second", "[1] is :odd: ", "replayed", "2/3"):
        assert text in shown
    assert "none" not in shown and "never" not in shown


@pytest.fixture
def clock(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(bars.time, "monotonic", lambda: now[0])
    return now


def test_a_line_a_minute_in_a_log_and_the_first_and_the_last(clock, capsys):
    with bars.bar("episodes") as shown:
        shown.start(300)
        for _ in range(300):
            clock[0] += 1.5
            shown.advance()
    lines = capsys.readouterr().err.splitlines()
    assert lines[:2] == ["episodes: 0 of 300", "episodes: 40 of 300, 1.5 s each, 6 min left, after 1 min"]
    assert lines[-1] == "episodes: 300 of 300, 1.5 s each, after 8 min"
    assert len(lines) == 9


def test_what_was_there_before_does_not_make_it_faster(clock, capsys):
    with pytest.raises(KeyboardInterrupt), bars.bar("layouts") as shown:
        shown.start(100, there=90)
        clock[0] += 20
        shown.advance()
        clock[0] += 20
        shown.advance()
        raise KeyboardInterrupt
    assert capsys.readouterr().err.splitlines() == [
        "layouts: 90 of 100",
        "layouts: 92 of 100, 20.0 s each, 3 min left, after 40 s",
    ]


def test_it_may_begin_with_the_first_that_is_done(clock, capsys):
    with bars.bar("episodes") as shown:
        clock[0] += 500  # of which nobody knows what they were for
        shown.at(3, 9)
        clock[0] += 2
        shown.next_of(9)
    assert capsys.readouterr().err.splitlines() == [
        "episodes: 3 of 9",
        "episodes: 4 of 9, 2.0 s each, 10 s left, after 2 s",
    ]


def test_what_has_a_verdict_is_quiet_for_a_minute(clock, capsys):
    with bars.bar("checked", transient=True) as shown:
        for done in range(1, 9):
            shown.at(done, 9)
            clock[0] += 10
    assert capsys.readouterr().err.splitlines() == ["checked: 7 of 9, 10.0 s each, 20 s left, after 1 min"]


@pytest.mark.parametrize(
    ("seconds", "said"), [(0, "0 s"), (59.4, "59 s"), (59.6, "1 min"), (3569, "59 min"), (3590, "1 h 0 min")]
)
def test_spans(seconds, said):
    assert bars.span(seconds) == said


def test_speed():
    assert bars.speed(40, 20, 0, 10) == "4.0 a second"
    assert bars.speed(5, 10, 5, 60) == bars.speed(5, 10, 0, 0) == ""
    assert bars.speed(9, 1000, 0, 900) == "100.0 s each, 27 h 32 min left"
