"""The status of a plan is read from its folder."""

import time

import pytest

from robocas_ms3.cli.main import run
from robocas_ms3.core.files import make_folder, write_json
from robocas_ms3.plans.folder import PLAN, Outcome, PlanFolder, WorkUnit
from robocas_ms3.plans.load import load_plan
from robocas_ms3.plans.status import PartStatus, estimate_seconds_left, read_status


@pytest.fixture
def started(tmp_path):
    """Start a plan; return its folder and a function that writes outcomes."""
    path, out = tmp_path / "plan.yaml", make_folder(tmp_path / "out")
    path.write_text("block: 4\nparts:\n  - {task: pick, episodes: 6, name: a}\n")
    folder = PlanFolder(load_plan(path), out)
    write_json(out / PLAN, folder.make_record())

    def write(*outcomes):
        for outcome in outcomes:
            unit = WorkUnit(0, outcome.seed // 4)
            with folder.seed_files(unit, outcome.seed).temporary_files() as files:
                files.write_outcome(outcome)
            folder.write_outcomes(unit)

    return out, write


def good(seed, at=0.0):
    return Outcome(seed, True, 100, record_seconds=1.0, render_seconds=3.0, size=10**6, end_time=at)


def test_status_before_and_after_a_work_unit_is_complete(started, tmp_path, capsys):
    assert run(["plan", "status", str(tmp_path)]) == 1
    out, write = started
    assert read_status(out).seconds_left is None
    write(*(good(seed, 1000.0 + 2 * seed) for seed in (0, 1, 3, 5)))
    failed = Outcome(2, False, failures=["a: b", "record: SIGSEGV"], record_seconds=2.0)
    for write_failed in (lambda: None, lambda: write(failed)):  # before and after the first unit is complete
        write_failed()
        found = read_status(out)
        (part,) = found.parts
        assert (part.done, part.requested, part.bytes) == (4, 6, 4 * 10**6)
        assert found.episodes_per_hour == 1080.0  # three in the 10 s after the first
    assert (part.tried, part.failed) == (5, {"record: SIGSEGV": 1})
    assert (part.record_seconds, part.render_seconds) == (1.5, 3.0)
    assert found.seconds_left == pytest.approx(2 * 10 / 3, abs=0.1)
    assert not found.finished
    assert run(["plan", "status", str(out)]) == 0
    assert "4 of 6" in capsys.readouterr().out


def test_status_shows_reasons_with_brackets(started, capsys):
    out, write = started
    write(Outcome(0, False, failures=["record: KeyError: [/red]"]))
    assert run(["plan", "status", str(out)]) == 0
    assert "KeyError: [/red] x1" in capsys.readouterr().out


def test_seconds_left_use_the_cost_per_part():
    def part(name, requested, done, seconds):
        return PartStatus(name, requested, done, done, {}, seconds, 0.0, 0)

    parts = [part("pick", 10, 10, 2.0), part("search", 5, 1, 20.0), part("select", 3, 0, 0.0)]
    # recent: ten picks and a search, 40 CPU s in 20 s; left: four searches, and three of a mean of 40 / 11
    left = 4 * 20.0 + 3 * 40.0 / 11
    assert estimate_seconds_left(parts, [0] * 10 + [1], 20.0) == pytest.approx(left / 2)
    free = [part("a", 10, 4, 0.0)]  # nothing says what they cost
    assert estimate_seconds_left(free, [0, 0], 4.0) == pytest.approx(12.0)


def test_rate_ignores_old_episodes_and_wrong_clocks(started):
    out, write = started
    now = time.time()
    write(good(0, now - 5000), good(1, now - 100), good(2, now), good(4, now + 86400))
    assert read_status(out).episodes_per_hour == 36.0
