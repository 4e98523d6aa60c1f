"""The page of the leaderboard: rows with ranks, filters, stages, links to videos, and untrusted texts."""

import json
import re

from synthetic_results import of_protocol

from robocas_ms3.evaluation.leaderboard.entries import find_card
from robocas_ms3.evaluation.leaderboard.output import PAGE, ROWS, AuditedResult, rank_rows, write_leaderboard_page
from robocas_ms3.evaluation.leaderboard.page import video_folder
from robocas_ms3.evaluation.leaderboard.rows import read_leaderboard
from robocas_ms3.evaluation.protocol import load_protocol
from robocas_ms3.evaluation.results import RUN, read_result

SMOKE = load_protocol("smoke")


def rename(result, name):
    record = json.loads((result.folder / RUN).read_text())
    record["policy"]["name"] = name
    (result.folder / RUN).write_text(json.dumps(record))
    return read_result(result.folder)


def make_results(tmp_path, *names):
    return [
        AuditedResult(rename(of_protocol(tmp_path / f"entry{number}" / "smoke", SMOKE), name), SMOKE, 3)
        for number, name in enumerate(names)
    ]


def test_page_has_a_row_per_task_and_the_published_results(tmp_path):
    results, out = make_results(tmp_path, "first", "second"), tmp_path / "out"
    assert [path.name for path in write_leaderboard_page(results, out)] == ["index.html", "results.md", "results.json"]
    rows = [row for row in read_leaderboard(out / ROWS).rows if not row.published]
    tasks = {episode.task for episode in SMOKE.episodes}
    assert {(row.policy, row.task) for row in rows} == {(name, task) for name in ("first", "second") for task in tasks}
    assert {(row.rank, row.audited) for row in rows} == {(1, 3)}  # equal results are ties
    page = (out / PAGE).read_text()
    assert page.count("<td>first</td>") == page.count("<td>second</td>") == len(tasks)
    assert len(re.findall("<summary>(?:first|second), smoke</summary>", page)) == 2
    assert "RT-1" in page and "<option>first</option>" in page


def test_page_has_the_model_card_of_each_entry(tmp_path):
    results, out = make_results(tmp_path, "first"), tmp_path / "out"
    find_card(results[0].result.folder).write_text("# Model card: <first>\n")
    write_leaderboard_page(results, out)
    assert "<pre># Model card: &lt;first&gt;" in (out / PAGE).read_text()


def test_videos_in_the_folder_of_a_result_are_linked(tmp_path):
    results, out = make_results(tmp_path, "first"), tmp_path / "out"
    folder = video_folder(out, results[0].result)
    assert folder == out / "videos" / "entry0" / "smoke"
    folder.mkdir(parents=True)
    (folder / "episode_00001.mp4").touch()
    write_leaderboard_page(results, out)
    assert '<a href="videos/entry0/smoke/episode_00001.mp4">' in (out / PAGE).read_text()


def test_texts_of_results_create_no_html_and_no_paths(tmp_path):
    results = make_results(tmp_path, "../../<script>alert(1)</script>")
    write_leaderboard_page(results, tmp_path / "out")
    page = (tmp_path / "out" / PAGE).read_text()
    assert "<script>alert" not in page and "&lt;script&gt;alert" in page
    assert tmp_path / "out" in video_folder(tmp_path / "out", results[0].result).parents


def test_policies_of_different_tracks_are_not_ranked_together(tmp_path):
    results = make_results(tmp_path, "first", "second")
    record = json.loads((results[1].result.folder / RUN).read_text())
    record["policy"]["spec"]["track"] = "privileged"
    (results[1].result.folder / RUN).write_text(json.dumps(record))
    results[1] = results[1]._replace(result=read_result(results[1].result.folder))
    assert all(row.rank_p_value is None for row in rank_rows(results))
    assert any(row.rank_p_value is not None for row in rank_rows(make_results(tmp_path / "again", "a", "b")))
