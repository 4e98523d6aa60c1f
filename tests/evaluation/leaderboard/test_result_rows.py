"""Rows of the leaderboard from synthetic results, with numbers computed by hand."""

import json

import pytest
from synthetic_results import of_protocol, outcome, write

from robocas_ms3.cli.eval_results import WriteTable, table
from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.evaluation.leaderboard.markdown import render_leaderboard
from robocas_ms3.evaluation.leaderboard.result_rows import make_rows
from robocas_ms3.evaluation.leaderboard.rows import Leaderboard, Training, read_leaderboard, write_leaderboard
from robocas_ms3.evaluation.protocols.protocol import load_protocol
from robocas_ms3.evaluation.results.result_files import OUTCOMES

TRAINED = {
    "name": "runs/mine",
    "spec": {"cameras": {"base_camera": [96, 72]}, "track": "modular"},
    "data": {"name": "demos", "hash": "12", "episodes": 720, "samples": 9000},
    "trained_in": "pick, in table, objects apple",
    "init_from": "",
    "steps": 3500,
    "training_seconds": 3360.0,
    "hardware": "1 x x86_64 CPU, 2 threads",
    "parameters": 1_857_000,
    "weights": "ee" * 32,
}


def test_row_of_a_trained_policy(tmp_path):
    # 1 of 4: the exact interval is 0.006309 to 0.80588; three episodes lifted an object, one never touched any
    outcomes = [outcome(0), outcome(1, 6), outcome(2, 5), outcome(3, 0, error="no plan", failure_stage="error")]
    (row,) = make_rows(write(tmp_path / "a", outcomes, policy=TRAINED, training_differences={"table": []}))
    assert (row.policy, row.track, row.task, row.split) == ("runs/mine", "modular", "pick", "test")
    assert (row.n, row.n_protocol, row.successes, row.errors, row.rate) == (4, None, 1, 1, 0.25)
    assert row.interval == (0.006309, 0.80588) and row.rate_v0 == 0.25
    assert row.stages == {
        "reached_any": 0.75,
        "picked_any": 0.75,
        "reached_target": 0.75,
        "target_grasped": 0.75,
        "target_lifted": 0.75,
        "target_in_basket": 0.5,
    }
    assert row.training == Training(
        data="demos",
        episodes=720,
        scenes="pick, in table, objects apple",
        steps=3500,
        seconds=3360,
        hardware="1 x x86_64 CPU, 2 threads",
    )
    assert (row.training_matches, row.parameters, row.calibration) == (True, 1_857_000, "nominal")
    assert (row.published, row.differences, row.weights) == (False, [], "ee" * 32)
    assert row.versions == {"robocas_ms3": "0.1.0", "torch": "2.4"}


def test_one_row_per_task_and_split_says_whether_the_policy_was_trained_in_its_scenes(tmp_path):
    outcomes = [outcome(0), outcome(1, 0, split="new", config="other"), outcome(2, task="select", config="select")]
    lacking = {"table": [], "other": ["objects plum"], "unused": []}
    rows = make_rows(write(tmp_path / "a", outcomes, policy=TRAINED, training_differences=lacking))
    found = {(row.task, row.split): (row.n, row.successes, row.training_matches) for row in rows}
    assert found == {("pick", "test"): (1, 1, True), ("pick", "new"): (1, 0, False), ("select", "test"): (1, 1, None)}


def test_row_of_an_untrained_policy_with_weld_and_noise(tmp_path):
    spec = {"state": True, "track": "end-to-end"}
    run = {"weld": True, "action_noise": [0.5, 0.2], "policy": {"name": "mine", "spec": spec}}
    (row,) = make_rows(write(tmp_path / "a", [outcome(0)], **run))
    assert (
        row.track == "privileged" and row.training is None and row.training_matches is None and row.calibration is None
    )
    assert row.differences == ["RoboCAS-v0's weld", "action noise of 0.5 mm and 0.2 degrees"]


@pytest.mark.parametrize(
    ("name", "expected"), [("runs/mine", "small"), ("mine", "small"), ("keyframe-upstream", "keyframe-upstream")]
)
def test_rows_of_a_run_folder_have_the_name_of_its_baseline(tmp_path, name, expected):
    policy = {**TRAINED, "baseline": "small", "name": name}
    (row,) = make_rows(write(tmp_path / "a", [outcome(0)], policy=policy))
    assert row.policy == expected


def test_description_of_a_served_policy_is_that_of_the_server(tmp_path):
    served = {"name": "ws://host:8000", "spec": {"track": "modular"}, "server": TRAINED}
    (row,) = make_rows(write(tmp_path / "a", [outcome(0)], policy=served))
    assert (row.policy, row.track, row.parameters) == ("ws://host:8000", "modular", 1_857_000)
    assert row.training is not None and row.training.steps == 3500


def test_number_of_episodes_of_an_alias_is_that_of_the_other_task(tmp_path):
    outcomes = [outcome(0, task="select", config="pick_upstream_eval")]
    made = write(tmp_path / "a", outcomes, protocol="paper-v1", played_as={"select": "pick"})
    (row,) = make_rows(made, load_protocol("paper-v1"))
    assert (row.task, row.n, row.n_protocol) == ("select", 1, 200)


@pytest.mark.parametrize("changed", [{"parameters": "many"}, {"spec": {"track": "fast"}}, {"data": {"episodes": -1}}])
def test_invalid_values_of_a_result_are_an_error(tmp_path, changed):
    made = write(tmp_path / "a", [outcome(0)], policy={**TRAINED, **changed})
    with pytest.raises(EvaluationError):
        make_rows(made)


def test_markdown_has_a_table_per_protocol_and_names_what_is_not_comparable(tmp_path):
    (row,) = make_rows(write(tmp_path / "a", [outcome(0)], policy=TRAINED, training_differences={"table": []}))
    short = row.model_copy(update={"n_protocol": 200, "errors": 1, "calibration": "true", "differences": ["weld"]})
    other = row.model_copy(update={"protocol_hash": "ff" * 32, "training_matches": False})
    text = render_leaderboard([short, other])
    first, second = (line for line in text.splitlines() if line.startswith("| runs/mine"))
    assert "| modular | pick | test | 1 | 100.0 (2.5 to 100.0) | 100.0 |" in first
    assert "| 720 episodes, pick, in table, objects apple | yes | 3500 steps, 56 min, 1 x x86_64 CPU" in first
    assert first.endswith("1 of 200 episodes; 1 episode ended by an error; true camera calibration; weld |")
    assert "| no |" in second and text.count("\n## ") == 2


def test_markdown_has_the_change_from_the_seen_split(tmp_path):
    (row,) = make_rows(write(tmp_path / "a", [outcome(0)], policy=TRAINED))
    counts = {"n": 80, "successes": 48, "rate": 0.6, "interval": (0.48, 0.71)}
    seen = row.model_copy(update={"split": "seen", **counts})
    new = row.model_copy(update={"split": "new", "n": 70, "successes": 56, "rate": 0.8, "interval": (0.69, 0.89)})
    other = new.model_copy(update={"weights": "ff" * 32})  # other weights have no row of the split
    text = render_leaderboard([seen, new, other])
    cells = [line.split(" | ")[6] for line in text.splitlines() if line.startswith("| runs/mine")]
    assert cells == ["", "+20.0 (+5.2 to +33.4)", ""] and "| success | change from seen |" in text
    assert "change from seen |" not in render_leaderboard([row])


def test_command_writes_rows_of_all_results_and_the_published_ones(tmp_path, capsys):
    write(tmp_path / "a", [outcome(0)])
    write(tmp_path / "b", [outcome(1, 0)])  # a shard of the same evaluation
    write(tmp_path / "c", [outcome(0)], policy=TRAINED)
    out = tmp_path / "board" / "results.json"
    for _ in range(2):  # an existing leaderboard is replaced
        assert table(WriteTable((tmp_path / "a", tmp_path / "b", tmp_path / "c"), out=out)) == 0
    rows = read_leaderboard(out).rows
    assert [(row.policy, row.n) for row in rows if not row.published] == [("runs/mine", 1), ("mine", 2)]
    assert sum(row.published for row in rows) == 6
    capsys.readouterr()
    write(tmp_path / "d", [outcome(0)], policy={**TRAINED, "name": "another"})
    assert table(WriteTable((tmp_path / "d",), out=out, update=True)) == 0
    assert [row.policy for row in read_leaderboard(out).rows if not row.published] == ["another", "runs/mine", "mine"]
    text, printed = out.with_suffix(".md").read_text(), capsys.readouterr().out
    assert all(name in text for name in ("| another |", "| mine |", "| RoboFlamingo |"))
    assert "| another |" in printed and "| mine |" not in printed, "only the rows of these results are printed"
    with pytest.raises(EvaluationError):
        table(WriteTable((tmp_path / "a",), out=tmp_path / "board.txt"))
    with pytest.raises(EvaluationError):
        table(WriteTable((), out=out))


def test_a_table_has_no_inconsistent_results(tmp_path):
    result = of_protocol(tmp_path / "result", load_protocol("smoke"))
    out = tmp_path / "rows.json"
    assert table(WriteTable((result.folder,), out=out)) == 0
    before, path = out.read_bytes(), result.folder / OUTCOMES
    first, *others = path.read_text().splitlines(keepends=True)
    changed = json.loads(first)
    path.write_text(json.dumps({**changed, "success": not changed["success"]}) + "\n" + "".join(others))
    with pytest.raises(EvaluationError):
        table(WriteTable((result.folder,), out=out))
    assert out.read_bytes() == before


def test_results_that_are_not_audited_are_marked_and_not_added_to_a_leaderboard(tmp_path):
    (row,) = make_rows(write(tmp_path / "a", [outcome(0)]))
    assert "not audited" in render_leaderboard([row])
    audited = row.model_copy(update={"entry": "mine", "audited": 1, "rank": 1})
    assert "not audited" not in render_leaderboard([audited])
    assert "not audited" not in render_leaderboard([audited.model_copy(update={"audited": 0})]), "not in the sample"
    assert "not audited" in render_leaderboard([audited, row])
    out = tmp_path / "rows.json"
    write_leaderboard(out, Leaderboard(rows=[audited]))
    before = out.read_bytes()
    with pytest.raises(EvaluationError):
        table(WriteTable((tmp_path / "a",), out=out, update=True))
    assert out.read_bytes() == before
