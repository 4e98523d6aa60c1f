"""The scripts that run LeRobot, with stand-ins for Python and for setup.sh that log their calls."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from robocas_ms3.datasets.lerobot.variants import NEWEST, VARIANTS

SCRIPTS = Path(__file__).resolve().parents[3] / "scripts"
SETUP = """
echo "setup $* renderer=$((1 - ${ROBOCAS_SKIP_RENDERER:-0})) python=$ROBOCAS_PYTHON" >>"$LOG"
mkdir -p "$ROBOCAS_VENV/bin"
cp "$STAND_IN" "$ROBOCAS_VENV/bin/python"
cp "$STAND_IN" "$ROBOCAS_VENV/bin/lerobot-train"
"""
STAND_IN = """#!/usr/bin/env bash
echo "$(basename "$0") $*" >>"$LOG"
if [ "$1 $2" = "-m venv" ]; then mkdir -p "${@: -1}/bin" && cp "$0" "${@: -1}/bin/python"; fi
"""


@pytest.fixture
def checkout(tmp_path):
    """A folder with the scripts, a stand-in for setup.sh, and a dataset without episodes."""
    root = tmp_path / "checkout"
    (root / "scripts").mkdir(parents=True)
    for path in (*SCRIPTS.glob("*lerobot*.sh"), *SCRIPTS.glob("*lerobot*.py")):
        shutil.copy(path, root / "scripts")
    (root / "scripts" / "setup.sh").write_text(SETUP)
    (root / "stand-in").write_text(STAND_IN)
    (root / "stand-in").chmod(0o755)
    (root / "data" / "meta").mkdir(parents=True)
    (root / "data" / "meta" / "info.json").write_text("{}")
    return root


def run_script(checkout, name, *words):
    """Run a script and return the calls that it made."""
    log = checkout / "log"
    log.write_text("")
    paths = {"LOG": log, "STAND_IN": checkout / "stand-in", "ROBOCAS_LEROBOT_PYTHON": checkout / "stand-in"}
    env = {**os.environ, **{key: str(path) for key, path in paths.items()}}
    for key in ("ROBOCAS_LEROBOT_VENV", "ROBOCAS_SKIP_RENDERER"):
        env.pop(key, None)
    command = ["bash", checkout / "scripts" / name, *words]
    subprocess.run(command, env=env, cwd=checkout, check=True, capture_output=True, text=True, timeout=60)
    return log.read_text().splitlines()


@pytest.mark.parametrize(
    ("name", "words", "renderer", "last"),
    [
        ("check_lerobot.sh", ["data"], 0, "python -W ignore scripts/check_lerobot.py"),
        ("check_lerobot_env.sh", [], 1, "python -W ignore scripts/check_lerobot_env.py"),
        ("train_lerobot.sh", ["act", "data", "out"], 0, "lerobot-train --policy.type=act"),
        ("serve_lerobot.sh", ["data"], 0, "python -W ignore -m robocas_ms3.baselines.lerobot.serve"),
    ],
)
def test_scripts_run_in_the_environment_of_setup(checkout, name, words, renderer, last):
    calls = run_script(checkout, name, *words)
    assert calls[0] == f"setup --lerobot renderer={renderer} python={checkout / 'stand-in'}"
    assert calls[-1].startswith(last)
    assert [path.name for path in checkout.glob(".venv*")] == [".venv-lerobot"]


@pytest.mark.parametrize("version", [version for version in VARIANTS if version != NEWEST])
def test_older_versions_have_environments_of_their_own(checkout, version):
    create, install, check = run_script(checkout, "check_lerobot.sh", "--version", version, "data")
    assert create.startswith("stand-in -m venv")
    assert "lerobot==" in install and "openai" not in install
    assert "scripts/check_lerobot.py" in check
    assert (checkout / f".venv-lerobot-{version}" / "bin" / "python").exists()
    assert run_script(checkout, "check_lerobot.sh", "--version", version, "data") == [check]


@pytest.mark.parametrize("begun", ["diffusion 0123 ", None])
def test_an_output_of_another_training_is_refused(tmp_path, begun):
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
    ("name", "words"),
    [
        ("train_lerobot.sh", []),
        ("train_lerobot.sh", ["act", "nowhere", "out"]),
        ("serve_lerobot.sh", []),
        ("check_lerobot.sh", ["--version", "0.6", "nowhere"]),
        ("check_lerobot.sh", ["--version", "0.7", "data"]),
    ],
)
def test_wrong_arguments_are_one_line(checkout, name, words):
    command = ["bash", SCRIPTS / name, *words]
    done = subprocess.run(command, cwd=checkout, capture_output=True, text=True, check=False, timeout=60)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert not list(checkout.glob(".venv*"))
