"""A plan's progress: bars in a terminal, plain lines in a log."""

import io

import pytest
from plan_stages import PLAN

from robocas_ms3.cli import bars, plan_progress
from robocas_ms3.cli.plan_progress import PlanProgress
from robocas_ms3.cli.terminal import console


@pytest.fixture
def shown(monkeypatch, tmp_path):
    """A progress on a made-up terminal or in a log, which looks and tells whenever it is asked; what it wrote."""

    def show(terminal):
        file = io.StringIO()
        shown = console(file=file, force_terminal=True, width=120) if terminal else None
        monkeypatch.setattr(plan_progress, "terminal_of_stderr", lambda: shown)
        monkeypatch.setattr(plan_progress, "_LOOK", 0.0)
        monkeypatch.setattr(bars, "EVERY", 0.0)
        found = type("Found", (), {"seconds_left": 5400.0, "episodes_an_hour": 120.0})
        monkeypatch.setattr(plan_progress, "status", lambda out: found)
        return PlanProgress(PLAN, tmp_path), file

    return show


def test_a_log_has_a_line_now_and_then(shown, capsys):
    progress, _ = shown(terminal=False)
    with progress:
        progress.at([0, 0])
        progress.at([5, 1])
        progress.note("joining the dataset")
        progress.at([5, 2])
    assert capsys.readouterr().err.splitlines() == [
        "0 of 7 episodes, 120 episodes an hour, 1 h 30 min left",
        "6 of 7 episodes (b 1 of 2), 120 episodes an hour, 1 h 30 min left",
        "joining the dataset",
        "7 of 7 episodes, 120 episodes an hour, 1 h 30 min left",
    ]


def test_the_last_line_comes_though_it_is_not_time(shown, capsys, monkeypatch):
    progress, _ = shown(terminal=False)
    monkeypatch.setattr(bars, "EVERY", 60.0)
    with progress:
        for counts in ([0, 0], [3, 0], [5, 2]):
            progress.at(counts)
        progress.note("joining the dataset")
    assert [line.partition(",")[0] for line in capsys.readouterr().err.splitlines()] == [
        "0 of 7 episodes",
        "7 of 7 episodes",
        "joining the dataset",
    ]


def test_a_terminal_has_a_bar_a_part_and_one_for_all(shown, capsys):
    progress, file = shown(terminal=True)
    with progress:
        progress.at([2, 0])
        progress.at([5, 1])
        progress.note("joining [red]the dataset")
    for text in ("5/5", "1/2", "6/7", "120 episodes an hour, 1 h 30 min left", "joining [red]the dataset"):
        assert text in file.getvalue()
    assert capsys.readouterr().err == ""
