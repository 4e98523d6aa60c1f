"""The page of a result: numbers, well-formed HTML, and no other files."""

import importlib.util
import re
from collections import Counter
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from synthetic_results import of_protocol, outcome, write

from robocas_ms3.cli.eval_results import Compare, Merge, Report, Verify, compare, merge, report, verify
from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.evaluation.protocols.protocol import load_protocol
from robocas_ms3.evaluation.report import PARQUET, write_report
from robocas_ms3.evaluation.report.page import render_page, video_file_name

VOID = {"meta", "rect", "path"}  # elements without an end tag


class Reader(HTMLParser):
    """Parser that checks that elements are closed, and collects texts and links."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.texts: list[str] = []
        self.links: list[str] = []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.links += [value for name, value in attrs if name in ("href", "src", "action", "data") and value]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        assert tag in VOID

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if data.strip() and self.open[-1] not in ("style", "script"):
            self.texts.append(data.strip())

    def after(self, text: str, count: int) -> list[str]:
        at = self.texts.index(text)
        return self.texts[at + 1 : at + 1 + count]


@pytest.fixture
def result(tmp_path):
    error = "the policy said <b>no</b> & died"
    table = [outcome(0), outcome(1), outcome(2, came_to=5), outcome(3, came_to=0, failure_stage="error", error=error)]
    heap = [outcome(number, config="heap", split="hard", p_vis=0.3) for number in (4, 5)]
    return write(tmp_path / "result", [*table, *heap])


def test_page_shows_rates_stages_failures_and_settings(result):
    read = Reader(render_page(result))
    # 2 of 4, 6.8 to 93.2; 2 of 2, 0.025 ** (1 / 2) = 15.8
    assert read.after("table", 4) == ["end-to-end", "4", "50 %", "7 to 93"]
    assert read.after("heap", 4) == ["end-to-end", "2", "100 %", "16 to 100"]
    assert "2 of 4: 50.0 %, 6.8 to 93.2" in read.texts  # title of the bar
    assert read.after("all", 3) == ["end-to-end", "6", "67 %"]
    assert read.after("table, n 4", 3) == ["an object touched (RA)", "3 of 4: 75.0 %, 19.4 to 99.4", "75 %"]
    assert {"placed, at rest", "ended by an error", "Ended by an error: 1 episode, counted as failed."} <= set(
        read.texts
    )
    assert {"hard, n", "test, n", "0.2 to 0.4"} <= set(read.texts)
    assert {"ab" * 32, "cd" * 32, "robocas_ms3 0.1.0, torch 2.4", "mine:Policy"} <= set(read.texts)
    assert read.after("Failed episodes", 1) == ["2"]
    assert "the policy said <b>no</b> & died" in read.texts


def test_page_names_the_weld(result, tmp_path):
    reader = Reader(render_page(write(tmp_path / "welded", result.outcomes.values(), weld=True)))
    assert any(text.startswith("With RoboCAS-v0's weld: ") for text in reader.texts)
    assert reader.after("RoboCAS-v0's weld", 1) == ["yes"]
    assert Reader(render_page(result)).after("RoboCAS-v0's weld", 1) == ["no"]


def test_page_names_the_action_noise(result, tmp_path):
    reader = Reader(render_page(write(tmp_path / "noisy", result.outcomes.values(), action_noise=[0.5, 0.2])))
    assert any(text.startswith("Measured with action noise of 0.5 mm and 0.2 degrees") for text in reader.texts)
    assert reader.after("action noise", 1) == ["action noise of 0.5 mm and 0.2 degrees"]
    assert Reader(render_page(result)).after("action noise", 1) == ["none"]


def test_page_links_only_its_own_videos(result):
    text = render_page(result, result.folder)
    assert Reader(text).links == []
    assert "robocas eval videos" in text
    assert not re.search(r"https?:|//[a-z]|@import|url\(", text)
    (result.folder / "videos").mkdir()
    (result.folder / "videos" / video_file_name(3)).touch()
    assert Reader(render_page(result, result.folder)).links == ["videos/episode_00003.mp4"]


def test_page_names_missing_episodes(tmp_path):
    protocol = load_protocol("smoke")
    whole = of_protocol(tmp_path / "whole", protocol)
    assert "8 of 8 episodes" in render_page(whole, protocol=protocol)
    part = write(tmp_path / "part", list(whole.outcomes.values())[:5])
    configs = Counter(outcome.config for outcome in list(whole.outcomes.values())[5:])
    of = ", ".join(f"{many} of {config}" for config, many in configs.items())
    assert f"Incomplete result: 3 episodes of the protocol missing ({of})." in render_page(part, protocol=protocol)


@pytest.mark.parametrize("count", [0, 1])
def test_small_results(tmp_path, count):
    Reader(render_page(write(tmp_path / "a", [outcome(0)][:count])))
    Reader(render_page(write(tmp_path / "b", [outcome(0, came_to=0)][:count])))


def test_columns(result, monkeypatch, capsys):
    parquet = pytest.importorskip("pyarrow.parquet", reason="needs the extra 'lerobot'")
    write_report(result, result.folder)
    table = parquet.read_table(result.folder / PARQUET).to_pydict()
    assert table["episode"] == list(range(6))
    assert table["flags.target_lifted"] == [50, 50, 50, None, 50, 50]
    assert table["flag_seconds.success"] == [3.5, 3.5, None, None, 3.5, 3.5]
    assert np.isclose(table["measures.path_length"], 1.5).all()
    assert table["p_vis"] == [None] * 4 + [0.3, 0.3]
    (result.folder / PARQUET).unlink()
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "pyarrow" else find(name))
    assert report(Report((result.folder,))) == 0
    assert not (result.folder / PARQUET).exists()
    assert "episodes.parquet was not written, because pyarrow is missing" in capsys.readouterr().out


def test_commands_on_partial_results(tmp_path, capsys):
    parts = [tmp_path / name for name in "abc"]
    for number, part in enumerate(parts):
        write(part, [outcome(number)], **({"policy": {"name": "other"}} if part.name == "c" else {}))
    assert report(Report((*parts[:2],))) == 0
    assert "2 episodes" in capsys.readouterr().out
    assert merge(Merge((*parts[:2],), out=tmp_path / "all")) == 0
    assert (tmp_path / "all" / "report.html").is_file()
    write(tmp_path / "d", [outcome(1)], policy={"name": "other"})
    assert compare(Compare((*parts, tmp_path / "d"))) == 0
    assert "1 episode of made_up in both results" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("command", "settings", "where"),
    [
        (report, Report(()), "DIR"),
        (merge, Merge((), out=Path("o")), "DIR"),
        (compare, Compare((Path("a"),)), Path("a")),
        (compare, Compare((Path("ok"),)), Path("ok")),
        (verify, Verify((Path("a"),)), Path("a")),
    ],
)
def test_wrong_folders_are_errors(tmp_path, monkeypatch, command, settings, where):
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "ok", [outcome(0)])
    with pytest.raises(EvaluationError) as caught:
        command(settings)
    assert caught.value.where == where
    assert [path.name for path in tmp_path.iterdir()] == ["ok"]
