"""A plan's progress: bars in a terminal, plain lines in a log."""

import io

import pytest
from plan_stages import PLAN

from robocas_ms3.cli import bars, plan_progress
from robocas_ms3.cli.plan_progress import PlanProgress
from robocas_ms3.cli.terminal import console
from robocas_ms3.plans.status import PartStatus, Status


def status(*done):
    """A status with some episodes of each part."""
    parts = [
        PartStatus(part.name, part.episodes, count, count, {}, 1.0, 1.0, 0)
        for part, count in zip(PLAN.parts, done, strict=True)
    ]
    return Status(parts, 120.0, 5400.0, 1.0, False)


@pytest.fixture
def shown(monkeypatch):
    """A progress on a made-up terminal or in a log, which writes whenever it is asked; what it wrote."""

    def show(terminal):
        file = io.StringIO()
        shown = console(file=file, force_terminal=True, width=120) if terminal else None
        monkeypatch.setattr(plan_progress, "terminal_of_stderr", lambda: shown)
        monkeypatch.setattr(bars, "EVERY", 0.0)
        return PlanProgress(PLAN), file

    return show


def test_a_log_has_a_line_now_and_then(shown, capsys):
    progress, _ = shown(terminal=False)
    with progress:
        progress.show(status(0, 0))
        progress.show(status(5, 1))
        progress.note("joining the dataset")
        progress.show(status(5, 2))
    assert capsys.readouterr().err.splitlines() == [
        "0 of 7 episodes, 120 episodes per hour, 1 h 30 min left",
        "6 of 7 episodes (b 1 of 2), 120 episodes per hour, 1 h 30 min left",
        "joining the dataset",
        "7 of 7 episodes, 120 episodes per hour, 1 h 30 min left",
    ]


def test_the_last_line_comes_though_it_is_not_time(shown, capsys, monkeypatch):
    progress, _ = shown(terminal=False)
    monkeypatch.setattr(bars, "EVERY", 60.0)
    with progress:
        for done in ((0, 0), (3, 0), (5, 2)):
            progress.show(status(*done))
        progress.note("joining the dataset")
    assert [line.partition(",")[0] for line in capsys.readouterr().err.splitlines()] == [
        "0 of 7 episodes",
        "7 of 7 episodes",
        "joining the dataset",
    ]


def test_a_terminal_has_a_bar_a_part_and_one_for_all(shown, capsys):
    progress, file = shown(terminal=True)
    with progress:
        progress.show(status(2, 0))
        progress.show(status(5, 1))
        progress.note("joining [red]the dataset")
    for text in ("5/5", "1/2", "6/7", "120 episodes per hour, 1 h 30 min left", "joining [red]the dataset"):
        assert text in file.getvalue()
    assert capsys.readouterr().err == ""
