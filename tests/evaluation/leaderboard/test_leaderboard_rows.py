"""The leaderboard file: published rows, sorting, and refused values."""

import json

import pytest

from robocas_ms3.core.errors import EvaluationError, OutputExistsError
from robocas_ms3.evaluation.leaderboard.rows import (
    Leaderboard,
    LeaderboardRow,
    Training,
    find_seen_row,
    read_leaderboard,
    read_published_rows,
    replace_rows,
    sort_rows,
    write_leaderboard,
)


def make_row(**values) -> LeaderboardRow:
    known = {"policy": "mine", "track": "end-to-end", "protocol": "paper-v1", "task": "pick", "split": "test"}
    return LeaderboardRow(**{**known, "n": 4, "successes": 1, "rate": 0.25, "interval": (0.0063, 0.8059), **values})


def test_published_rows_are_those_of_the_paper():
    rows = read_published_rows()
    rates = {(row.policy, row.task): row.rate_v0 for row in rows}
    assert rates == {
        ("RT-1", "pick"): 0.342,
        ("RT-1", "select"): 0.233,
        ("RT-1", "search"): 0.102,
        ("RoboFlamingo", "pick"): 0.156,
        ("RoboFlamingo", "select"): 0.133,
        ("RoboFlamingo", "search"): 0,
    }
    for row in rows:
        assert row.published and row.rate is None and row.n is None and "RoboCAS-v0's weld" in row.differences
        assert row.training is not None
        assert row.training.episodes == {"pick": 2800, "select": 3000, "search": 1500}[row.task]


def test_rows_are_sorted_by_protocol_task_split_track_and_rate(tmp_path):
    better = make_row(policy="better", successes=2, rate=0.5)
    knowing = make_row(policy="knowing", track="privileged")
    search, other = make_row(task="search"), make_row(protocol="clutter-v1")
    published = read_published_rows()[0]
    rows = sort_rows([published, search, make_row(), better, knowing, other])
    assert rows == [other, knowing, better, make_row(), search, published]
    write_leaderboard(tmp_path / "rows.json", Leaderboard(rows=rows))
    assert read_leaderboard(tmp_path / "rows.json").rows == rows


def test_new_rows_replace_those_with_the_same_conditions():
    published = read_published_rows()[0]
    trained = make_row(training=Training(data="other"))
    kept = [make_row(task="search"), make_row(policy="other"), make_row(differences=["weld"]), trained]
    new = make_row(successes=2, rate=0.5, weights="ab")
    assert replace_rows([published, make_row(), *kept], [new]) == [new, *kept]


def test_the_seen_row_is_of_the_same_entry():
    """Incident: two policy servers with one address shared the row of the split seen."""
    first, second = (
        [make_row(policy="ws://localhost:8000", entry=entry, split=split) for split in ("seen", "new")]
        for entry in ("first", "second")
    )
    assert find_seen_row(second[1], [*first, *second]) is second[0]
    assert find_seen_row(second[1], first) is None


def test_a_row_with_fewer_episodes_replaces_none():
    with pytest.raises(EvaluationError) as error:
        replace_rows([make_row()], [make_row(n=2, rate=0.5)])
    assert (error.value.expected, error.value.found) == ("at least 4", 2)
    assert replace_rows([make_row()], [make_row(n=2, rate=0.5, track="modular")])[0] == make_row()


@pytest.mark.parametrize(
    "values",
    [
        {"track": "fast"},
        {"rate": 0.3},  # 1 of 4 is 0.25
        {"successes": 5, "rate": 1.0},
        {"rate": None},  # a measured row
        {"n": 0},
        {"rate_v0": 1.5},
        {"calibration": "exact"},
        {"unknown": 1},
    ],
)
def test_invalid_rows_are_refused(tmp_path, values):
    path = tmp_path / "rows.json"
    path.write_text(json.dumps({"kind": "robocas results", "rows": [make_row().model_dump() | values]}))
    with pytest.raises(EvaluationError) as error:
        read_leaderboard(path)
    assert str(error.value.where).startswith(str(path))


def test_other_files_are_not_replaced(tmp_path):
    path = tmp_path / "rows.json"
    for content in ('{"rows": 3}', "notes"):
        path.write_text(content)
        with pytest.raises(OutputExistsError):
            write_leaderboard(path, Leaderboard(rows=[]))
        assert path.read_text() == content
    with pytest.raises(EvaluationError):
        read_leaderboard(tmp_path / "missing.json")
