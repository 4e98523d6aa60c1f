"""A plan's progress: bars in a terminal, plain lines in a log."""

import io

import pytest
from plan_stages import PLAN
from rich.console import Console

from robocas_ms3.cli import bars, plan_progress
from robocas_ms3.cli.plan_progress import PlanProgress, _span


@pytest.fixture
def shown(monkeypatch, tmp_path):
    """A progress on a made-up terminal or log, which looks and tells whenever it is asked; what it wrote."""

    def show(terminal):
        file = io.StringIO()
        monkeypatch.setattr(
            plan_progress, "Console", lambda **_: Console(file=file, force_terminal=terminal, width=100)
        )
        monkeypatch.setattr(plan_progress, "_LOOK", 0.0)
        monkeypatch.setattr(bars, "EVERY", 0.0)
        found = type("Found", (), {"seconds_left": 5400.0, "episodes_an_hour": 120.0})
        monkeypatch.setattr(plan_progress, "status", lambda out: found)
        return PlanProgress(PLAN, tmp_path), file

    return show


def test_a_log_has_a_line_now_and_then(shown, capsys, tmp_path):
    progress, file = shown(terminal=False)
    with progress:
        progress.begin()
        progress.at([0, 0])
        progress.at([5, 1])
        progress.stage("joining the dataset")
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == f"{tmp_path}: 7 episodes of 2 parts"
    assert lines[1].startswith("0 of 7 episodes; 120 episodes an hour, 90 min left")
    assert lines[2].startswith("6 of 7 episodes; b 1 of 2; 120 episodes an hour, 90 min left")
    assert lines[3] == "joining the dataset"
    assert file.getvalue() == ""


def test_a_terminal_has_a_bar_a_part_and_one_for_all(shown, capsys):
    progress, file = shown(terminal=True)
    with progress:
        progress.begin()
        progress.at([2, 0])
        progress.at([5, 1])
        progress.stage("joining [red]the dataset")
    text = file.getvalue()
    assert "5/5" in text
    assert "1/2" in text
    assert "6/7" in text
    assert "120 episodes an hour, 90 min left" in text
    assert "joining [red]the dataset" in text
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("seconds", "said"), [(40, "40 s"), (119, "119 s"), (720, "12 min"), (12600, "3.5 h"), (181440, "2.1 days")]
)
def test_spans(seconds, said):
    assert _span(seconds) == said
