"""The page of the leaderboard: rows with ranks, filters, stages, links to videos, and untrusted texts."""

import json
import math
import re
from dataclasses import replace

import pytest
from synthetic_results import of_protocol

from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.evaluation.leaderboard import entries
from robocas_ms3.evaluation.leaderboard.entries import find_card
from robocas_ms3.evaluation.leaderboard.markdown import render_leaderboard
from robocas_ms3.evaluation.leaderboard.output import (
    MARKDOWN,
    PAGE,
    ROWS,
    AuditedResult,
    rank_rows,
    write_leaderboard_page,
)
from robocas_ms3.evaluation.leaderboard.page import video_folder
from robocas_ms3.evaluation.leaderboard.rows import read_leaderboard
from robocas_ms3.evaluation.protocols.protocol import load_protocol
from robocas_ms3.evaluation.results.result_files import RUN, read_result

SMOKE = load_protocol("smoke")


def change_policy(result, **values):
    return change_run(result, policy=result.run.policy.model_dump(exclude_unset=True) | values)


def change_run(result, **values):
    record = json.loads((result.folder / RUN).read_text())
    (result.folder / RUN).write_text(json.dumps(record | values))
    return read_result(result.folder)


def make_results(tmp_path, *names):
    return [
        AuditedResult(of_protocol(tmp_path / name / "smoke", SMOKE), SMOKE, {0: "exact", 1: "exact", 2: "checkpoints"})
        for name in names
    ]


def test_page_has_a_row_per_task_and_the_published_results(tmp_path):
    results, out = make_results(tmp_path, "first", "second"), tmp_path / "out"
    assert [path.name for path in write_leaderboard_page(results, out)] == ["index.html", "results.md", "results.json"]
    rows = [row for row in read_leaderboard(out / ROWS).rows if not row.published]
    tasks = {episode.task for episode in SMOKE.episodes}
    assert {(row.entry, row.task) for row in rows} == {(name, task) for name in ("first", "second") for task in tasks}
    assert {row.rank for row in rows} == {1}  # equal results are ties
    audited = {(row.task, row.audited, row.audited_with_tolerances) for row in rows}
    assert audited == {("pick", 2, 0), ("select", 0, 1), ("search", 0, 0), ("open_pick", 0, 0)}
    page = (out / PAGE).read_text()
    assert page.count("<td>first (mine)<small>") == page.count("<td>second (mine)<small>") == len(tasks)
    assert re.findall("<summary>(first|second|smoke)</summary>", page) == ["first", "smoke", "second", "smoke"]
    assert "RT-1" in page and "<option>first (mine)</option>" in page


def test_page_has_the_model_card_of_each_entry(tmp_path):
    results, out = make_results(tmp_path, "first"), tmp_path / "out"
    text = "# Model card: <first>\n\n| a | b |\n|---|---|\n| 1 | [x](javascript:alert) |\n\n![y](https://other/z.png)\n\n<script>alert(1)</script>\n"
    find_card(results[0].result.folder).write_text(text)
    write_leaderboard_page(results, out)
    page = (out / PAGE).read_text()
    assert "<h3>Model card: &lt;first&gt;</h3>" in page and "<td>1</td>" in page
    assert 'href="javascript' not in page and "<img" not in page and "<script>alert" not in page


def test_results_with_problems_are_named(tmp_path):
    results, out = make_results(tmp_path, "first"), tmp_path / "out"
    write_leaderboard_page(results, out, ["second/paper-v1"])
    assert "second/paper-v1" in (out / PAGE).read_text() and "second/paper-v1" in (out / MARKDOWN).read_text()


def test_videos_in_the_folder_of_a_result_are_linked(tmp_path):
    results, out = make_results(tmp_path, "first"), tmp_path / "out"
    folder = video_folder(out, results[0].result)
    assert folder.parent == out / "videos" / "first" / "smoke"
    folder.mkdir(parents=True)
    (folder / "episode_00001.mp4").touch()
    write_leaderboard_page(results, out)
    link = f'<a href="videos/first/smoke/{folder.name}/episode_00001.mp4">'
    assert link in (out / PAGE).read_text()
    other = change_run(results[0].result, action_noise=[1.0, 1.0])  # another result in the same folder
    write_leaderboard_page([results[0]._replace(result=other)], out)
    assert link not in (out / PAGE).read_text()


def test_texts_of_results_create_no_html_and_no_paths(tmp_path):
    (true,) = make_results(tmp_path, "first")
    results = [true._replace(result=change_policy(true.result, name="../../<script>alert(1)</script>"))]
    write_leaderboard_page(results, tmp_path / "out")
    page = (tmp_path / "out" / PAGE).read_text()
    assert "<script>alert" not in page and "&lt;script&gt;alert" in page
    assert tmp_path / "out" in video_folder(tmp_path / "out", results[0].result).parents


def test_policies_of_different_tracks_are_not_ranked_together(tmp_path):
    results = make_results(tmp_path, "first", "second")
    spec = {"track": "privileged", "rate_hz": 20}
    results[1] = results[1]._replace(result=change_policy(results[1].result, spec=spec))
    assert all(row.rank_p_value is None for row in rank_rows(results))
    assert any(row.rank_p_value is not None for row in rank_rows(make_results(tmp_path / "again", "a", "b")))


def test_rows_with_differences_have_no_rank(tmp_path):
    results = make_results(tmp_path, "first", "second")
    results[1] = results[1]._replace(result=change_run(results[1].result, action_noise=[5.0, 2.0]))
    assert {(row.entry, row.rank) for row in rank_rows(results)} == {("first", 1), ("second", None)}


def test_a_policy_is_in_the_leaderboard_once_but_names_of_policies_may_be_equal(tmp_path):
    results = make_results(tmp_path, "first", "second")
    assert {row.name for row in rank_rows(results)} == {"first (mine)", "second (mine)"}
    weights = [one._replace(result=change_policy(one.result, weights="ab" * 32)) for one in results]
    with pytest.raises(EvaluationError):
        rank_rows(weights)


def test_success_that_differs_in_episodes_without_stored_actions_is_noted(tmp_path, monkeypatch):
    monkeypatch.setattr(entries, "SAMPLE_SIZE", 25)
    protocol = load_protocol("paper-v1")
    folder, picks = tmp_path / "mine" / "paper-v1", {one.episode for one in protocol.episodes if one.task == "pick"}
    made = of_protocol(folder, protocol)
    stored = set(entries.list_stored_episodes(made, protocol))
    failed = {number: replace(one, success=number not in stored) for number, one in made.outcomes.items()}
    (row, *_) = rank_rows([AuditedResult(replace(made, outcomes=failed), protocol, {})])
    inside = len(stored & picks)
    assert row.task == "pick" and row.sample_p_value is not None
    # Fisher's exact test: all successes are outside of the sample in one of comb(200, inside) ways
    assert row.sample_p_value == pytest.approx(1 / math.comb(200, inside), rel=1e-6)
    assert "with and without stored actions" in render_leaderboard([row])
    (row, *_) = rank_rows([AuditedResult(made, protocol, {})])
    assert row.sample_p_value == 1 and "with and without" not in render_leaderboard([row])
