"""`robocas view`: serve a page until Ctrl-C, or write it to a folder."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest
from synthetic import write_trajectory

from robocas_ms3.cli.main import run

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def trajectory(tmp_path_factory):
    return write_trajectory(tmp_path_factory.mktemp("run") / "trajectory.h5", seeds=(3, 4))


@pytest.mark.parametrize("ending", [signal.SIGINT, signal.SIGTERM])
def test_page_is_served_until_interrupted(trajectory, ending):
    words = [sys.executable, str(ROOT / "robocas_cli.py"), "view", str(trajectory), "--no-open"]
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment) as process:
        assert process.stdout is not None and process.stderr is not None
        try:
            line = process.stdout.readline()
            match = re.search(r"http://127\.0\.0\.1:\d+/", line)
            assert match, line + process.stderr.read()
            assert b"<!doctype html>" in urllib.request.urlopen(match[0], timeout=30).read()
            process.send_signal(ending)
            out, err = process.communicate(timeout=30)
        finally:
            process.kill()  # else a failure would wait for it for ever
    assert (process.returncode, out, err) == (0, "stopped\n", "")


def test_static_page(trajectory, tmp_path, capsys):
    out = tmp_path / "page"
    assert run(["view", str(trajectory), "--static", str(out)]) == 0
    assert capsys.readouterr().out.strip() == f"wrote {out / 'index.html'}: 2 episodes"
    assert {path.name for path in out.iterdir()} == {"index.html", "page", "data"}
    assert run(["view", str(trajectory), "--static", str(out)]) == 1
    assert "--overwrite" in capsys.readouterr().err
    assert run(["view", str(trajectory), "--static", str(out), "--overwrite", "--episodes", "1"]) == 0
    assert sorted(path.name for path in (out / "data").iterdir()) == ["episode_1.js", "index.js"]


def test_overwrite_replaces_only_static_pages(trajectory, tmp_path, capsys):
    (tmp_path / "notes.txt").write_text("mine")
    assert run(["view", str(trajectory), "--static", str(tmp_path), "--overwrite"]) == 1
    assert "was not written by this command" in capsys.readouterr().err
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_unknown_episode_is_one_line(trajectory, tmp_path, capsys):
    assert run(["view", str(trajectory), "--static", str(tmp_path / "x"), "--episodes", "7"]) == 2
    (error,) = capsys.readouterr().err.splitlines()
    assert "no such episode" in error
    assert not (tmp_path / "x").exists()
