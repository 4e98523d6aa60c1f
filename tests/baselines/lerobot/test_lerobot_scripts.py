"""The scripts around LeRobot's environment, as far as they go without it."""

import re
import subprocess
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).resolve().parents[3] / "scripts"


def test_both_make_one_environment():
    """They share a folder, and whichever found other packages in it would make it anew."""
    lists = [
        re.search(r"(?i)^packages=\((.*?)\)", (SCRIPTS / name).read_text(), re.MULTILINE)
        for name in ("check_lerobot.sh", "lerobot_environment.sh")
    ]
    assert lists[0] and lists[1]
    assert lists[0][1] == lists[1][1]


@pytest.mark.parametrize("begun", ["diffusion 0123 ", None])
def test_an_out_of_something_else_is_not_gone_on_with(tmp_path, begun):
    (tmp_path / "data" / "meta").mkdir(parents=True)
    (tmp_path / "data" / "meta" / "info.json").write_text("{}")
    (tmp_path / "out" / "dataset").mkdir(parents=True)
    if begun:
        (tmp_path / "out" / "asked").write_text(begun)
    words = ["bash", SCRIPTS / "train_lerobot.sh", "act", tmp_path / "data", tmp_path / "out", "40000"]
    done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1 and "name another out" in done.stderr.lower()
    assert [path.name for path in (tmp_path / "out").iterdir() if path.name != "asked"] == ["dataset"]


@pytest.mark.parametrize(
    "name, words", [("train_lerobot.sh", []), ("train_lerobot.sh", ["act", "nowhere", "out"]), ("serve_lerobot.sh", [])]
)
def test_wrong_words_are_told_how(tmp_path, name, words):
    done = subprocess.run(
        ["bash", SCRIPTS / name, *words], cwd=tmp_path, capture_output=True, text=True, check=False, timeout=60
    )
    assert done.returncode == 2
    assert f"bash scripts/{name}" in done.stderr
    assert done.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())
