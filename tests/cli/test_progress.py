"""Progress: bars on a terminal; in a log the first line, one line per minute, and the last line."""

import io
import os
import re
import subprocess
import sys

import pytest
from plan_stages import PLAN

from robocas_ms3.cli import progress
from robocas_ms3.cli.terminal import console
from robocas_ms3.plans.status import PartStatus, PlanStatus

SCRIPT = """
from robocas_ms3.cli.progress import ProgressBar, spinner
from robocas_ms3.cli.terminal import print_line
with spinner("reading files"):
    pass
with ProgressBar("counted") as bar:
    bar.start(2)
    bar.advance()
    bar.add_note("[1] is :odd: " + 90 * "x")
    print_line("one")
    bar.update(2, 2)
with ProgressBar("replayed", transient=True) as bar:
    bar.update(1, 3)
    bar.update(2, 3)
with ProgressBar("none") as bar:
    bar.start(0)
with ProgressBar("never started") as bar:
    pass
print_line("done")
"""


def run(*, forced="", **kwargs):
    environment = {k: v for k, v in os.environ.items() if k != "FORCE_COLOR"} | ({forced: "1"} if forced else {})
    command = [sys.executable, "-c", SCRIPT]
    return subprocess.run(command, check=True, env={**environment, "TERM": "xterm"}, timeout=60, **kwargs)


def test_log():
    done = run(forced="FORCE_COLOR", capture_output=True)
    assert done.stdout == b"one\ndone\n"
    noted = b"[1] is :odd: " + 90 * b"x"
    assert done.stderr.splitlines() == [b"counted: 0/2", noted, done.stderr.splitlines()[-1]]
    assert re.fullmatch(rb"counted: 2/2, [0-9.]+ it/s", done.stderr.splitlines()[-1])
    assert b"\r" not in done.stderr and b"\x1b" not in done.stderr


@pytest.mark.skipif(not hasattr(os, "openpty"), reason="needs a pseudo-terminal")
def test_terminal():
    terminal, end = os.openpty()
    try:
        done = run(stdout=subprocess.PIPE, stderr=end, text=True)
        os.close(end)
        shown = os.read(terminal, 1 << 16).decode()
    finally:
        os.close(terminal)
    assert done.stdout == "one\ndone\n"  # the bars are on stderr
    for text in ("reading files", "counted", "2/2", "it/s", "[1] is :odd: ", "replayed", "2/3"):
        assert text in shown
    assert "none" not in shown and "never" not in shown


@pytest.fixture
def clock(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    return now


def test_log_has_first_line_one_per_minute_and_last(clock, capsys):
    with progress.ProgressBar("episodes") as bar:
        bar.start(300)
        for _ in range(300):
            clock[0] += 1.5
            bar.advance()
    lines = capsys.readouterr().err.splitlines()
    assert lines[:2] == ["episodes: 0/300", "episodes: 40/300, 1.5 s/it, 6 min left, 1 min elapsed"]
    assert lines[-1] == "episodes: 300/300, 1.5 s/it, 8 min elapsed"
    assert len(lines) == 9


def test_initial_items_do_not_count_for_the_speed(clock, capsys):
    with pytest.raises(KeyboardInterrupt), progress.ProgressBar("layouts") as bar:
        clock[0] += 500  # before the first item
        bar.update(90, 100)
        clock[0] += 40
        bar.update(91, 100)
        bar.update(92, 100)
        raise KeyboardInterrupt
    assert capsys.readouterr().err.splitlines() == [
        "layouts: 90/100",
        "layouts: 92/100, 20.0 s/it, 3 min left, 40 s elapsed",
    ]


def test_transient_bar_logs_nothing_in_the_first_minute(clock, capsys):
    with progress.ProgressBar("checked", transient=True) as bar:
        for done in range(1, 9):
            bar.update(done, 9)
            clock[0] += 10
    assert capsys.readouterr().err.splitlines() == ["checked: 7/9, 10.0 s/it, 20 s left, 1 min elapsed"]


@pytest.mark.parametrize(
    ("seconds", "said"),
    [(0, "0 s"), (59.4, "59 s"), (59.6, "1 min"), (3569, "59 min"), (3590, "1 h 0 min"), (99000, "27 h 30 min")],
)
def test_format_duration(seconds, said):
    assert progress.format_duration(seconds) == said


def plan_status(*done):
    parts = [
        PartStatus(part.name, part.episodes, count, count, {}, 1.0, 1.0, 0)
        for part, count in zip(PLAN.parts, done, strict=True)
    ]
    return PlanStatus(parts, 120.0, 5400.0, 1.0, False)


def test_plan_in_a_log(clock, capsys):
    display = progress.ProgressDisplay()
    for done in ((0, 0), (3, 0), (5, 1)):
        progress.show_plan(display, plan_status(*done))
        clock[0] += 31
    display.flush()  # before the next minute
    display.add_note("joining the dataset")
    progress.show_plan(display, plan_status(5, 2))
    display.close()
    speed = "120 episodes/h, 1 h 30 min left"
    assert capsys.readouterr().err.splitlines() == [
        f"episodes: 0/7, {speed}",
        f"episodes: 6/7 (b 1/2), {speed}, 1 min elapsed",
        "joining the dataset",
        f"episodes: 7/7, {speed}, 2 min elapsed",
    ]


def test_plan_on_a_terminal_has_one_bar_per_part_and_one_for_all(monkeypatch, capsys):
    file = io.StringIO()
    terminal = console(file=file, force_terminal=True, width=120)
    monkeypatch.setattr(progress, "terminal_of_stderr", lambda: terminal)
    display = progress.ProgressDisplay()
    for done in ((2, 0), (5, 1)):
        progress.show_plan(display, plan_status(*done))
    display.add_note("joining [red]the dataset")
    display.close()
    for text in ("5/5", "1/2", "6/7", "120 episodes/h, 1 h 30 min left", "joining [red]the dataset"):
        assert text in file.getvalue()
    assert capsys.readouterr().err == ""
