"""Commands that write datasets, killed at any moment and continued."""

import importlib.util
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from managing import as_v0, files_of, make
from synthetic import RayCaster, render_by

from robocas_ms3.cli.main import run
from robocas_ms3.datasets.conversion import convert as conversion

KILL_DURING = Path(__file__).parents[1] / "support" / "kill_during.py"
CONVERT = ("convert", "F.h5", "--no-embeddings")
LEROBOT = ("convert", "F.h5", "--to", "lerobot")
MERGE = ("merge", "a", "b")
IMPORT = ("import-robocas", "v0")


@pytest.fixture(scope="module")
def inputs(trajectory, tmp_path_factory):
    folder = tmp_path_factory.mktemp("inputs")
    for suffix in (".h5", ".json"):
        shutil.copy(trajectory.with_suffix(suffix), folder)
    for name, seeds in (("a", (10, 11)), ("b", (20, 21)), ("v0", (30, 31))):
        make(folder, name, seeds)
    as_v0(folder / "v0")
    return folder


@pytest.fixture(autouse=True)
def stub_images(monkeypatch):
    monkeypatch.setattr(conversion, "convert", render_by(RayCaster, conversion.convert))
    if importlib.util.find_spec("av") and importlib.util.find_spec("pyarrow"):
        from robocas_ms3.datasets.lerobot import convert as lerobot

        monkeypatch.setattr(lerobot, "convert_lerobot", render_by(RayCaster, lerobot.convert_lerobot))


@pytest.mark.parametrize(
    ("words", "moment"),
    [
        (CONVERT, "image"),  # of the second episode; the preview of the first is whole
        *(((*CONVERT, "--no-video"), moment) for moment in ("arrays", "rename", "convert overview", "rmtree")),
        *((MERGE, moment) for moment in ("file", "rename", "merge overview")),
        *((LEROBOT, moment) for moment in ("frame", "join", "table", "folders", "joined", "parts")),
        *((IMPORT, moment) for moment in ("file", "import overview")),
    ],
    ids=lambda value: value if isinstance(value, str) else value[0],
)
def test_command_continued_after_kill_gives_the_same_files(inputs, tmp_path, monkeypatch, words, moment):
    if words == LEROBOT:
        pytest.importorskip("av", reason="needs the extra 'lerobot'")
        pytest.importorskip("pyarrow", reason="needs the extra 'lerobot'")
    monkeypatch.chdir(inputs)
    whole, out = tmp_path / "whole", tmp_path / "out"
    assert run([*words, "--out", str(whole)]) == 0
    overwrite = ["--overwrite"] if moment == "rmtree" else []
    if overwrite:
        shutil.copytree(whole, out)
    command = [sys.executable, str(KILL_DURING), moment, *words, "--out", str(out), *overwrite]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    assert done.returncode == -signal.SIGKILL, done.stderr
    assert overwrite or not (out / "data_info.json").exists()
    if (out / "meta/info.json").exists():  # a name that LeRobot opens: all is whole
        from robocas_ms3.datasets.lerobot.check import check_lerobot

        assert check_lerobot(out).violations == []
    assert run([*words, "--out", str(out)]) == 0
    assert files_of(out) == files_of(whole)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "whole"]
