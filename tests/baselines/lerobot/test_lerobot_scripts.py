"""Checks of the scripts that run LeRobot, before they create an environment."""

import subprocess
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).resolve().parents[3] / "scripts"


def run_refused_script(folder, name, *words):
    command = ["bash", SCRIPTS / name, *words]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False, timeout=60)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    return done.stderr


@pytest.mark.parametrize("settings", ["diffusion 0123 ", None])
def test_output_folder_of_another_training_is_refused(tmp_path, settings):
    (tmp_path / "data" / "meta").mkdir(parents=True)
    (tmp_path / "data" / "meta" / "info.json").write_text("{}")
    (tmp_path / "out" / "dataset").mkdir(parents=True)
    if settings:
        (tmp_path / "out" / "settings.txt").write_text(settings)
    assert str(tmp_path / "out") in run_refused_script(tmp_path, "train_lerobot.sh", "act", "data", "out", "40000")
    assert [path.name for path in (tmp_path / "out").iterdir() if path.name != "settings.txt"] == ["dataset"]
