"""The scripts around LeRobot's environment, as far as they go without it."""

import re
import subprocess
from pathlib import Path

import pytest

from robocas_ms3.datasets.lerobot.variants import VARIANTS

SCRIPTS = Path(__file__).resolve().parents[3] / "scripts"


@pytest.mark.parametrize("name", ["check_lerobot.sh", "train_lerobot.sh", "serve_lerobot.sh"])
def test_all_scripts_share_one_environment(name):
    """A second list of packages would make the environment again at each change of the script."""
    text = (SCRIPTS / name).read_text()
    assert ". scripts/lerobot_environment.sh" in text
    assert "-m pip" not in text


@pytest.mark.parametrize("version", VARIANTS)
def test_each_version_has_a_reader(version):
    text = (SCRIPTS / "lerobot_environment.sh").read_text()
    assert re.search(rf"^{re.escape(version)}\) packages=\(.*lerobot.*==", text, re.MULTILINE)


def test_an_unknown_version_is_refused(tmp_path):
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "info.json").write_text("{}")
    words = ["bash", SCRIPTS / "check_lerobot.sh", "--version", "0.7", tmp_path]
    done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=60)
    assert (done.returncode, done.stderr) == (2, "unknown LeRobot version '0.7': expected 0.6, 0.5 or 2.1\n")


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
    "name, words",
    [
        ("train_lerobot.sh", []),
        ("train_lerobot.sh", ["act", "nowhere", "out"]),
        ("serve_lerobot.sh", []),
        ("check_lerobot.sh", []),
        ("check_lerobot.sh", ["--version", "0.6", "nowhere"]),
    ],
)
def test_wrong_words_are_told_how(tmp_path, name, words):
    done = subprocess.run(
        ["bash", SCRIPTS / name, *words], cwd=tmp_path, capture_output=True, text=True, check=False, timeout=60
    )
    assert done.returncode == 2
    assert f"bash scripts/{name}" in done.stderr
    assert done.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())
