"""On CI nothing is passed over in silence: a missing browser or renderer fails."""

import importlib.util
import os
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
OUTCOMES = (pytest.fail.Exception, pytest.skip.Exception)


def test_ci_runs_the_tests_with_both_versions_of_numpy(tmp_path):
    fake_python = tmp_path / ".venv-numpy1" / "bin" / "python"
    for path, text in (
        (tmp_path / ".ci" / "run", (ROOT / ".ci" / "run").read_text()),
        (tmp_path / "scripts" / "test.sh", 'echo "test $PWD $CI ${ROBOCAS_NUMPY:-locked}"\n'),
        (tmp_path / "scripts" / "setup.sh", 'echo "setup $ROBOCAS_VENV $ROBOCAS_NUMPY"\n'),
        (fake_python, '#!/bin/bash\necho "python $2 $CI"\n'),
    ):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    fake_python.chmod(0o755)
    command = ["bash", tmp_path / ".ci" / "run"]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env={"PATH": os.environ["PATH"]})
    lines = [f"test {tmp_path} true locked", "setup .venv-numpy1 1.26.4", "python pytest true"]
    assert done.stdout.splitlines() == lines


@pytest.mark.parametrize(
    ("ci", "outcome"), [("true", "Failed"), ("1", "Failed"), ("yes", "Failed"), ("", "Skipped"), ("false", "Skipped")]
)
def test_without_a_renderer(monkeypatch, ci, outcome):
    spec = importlib.util.spec_from_file_location("_shared_by_all_tests", ROOT / "tests" / "conftest.py")
    assert spec is not None and spec.loader is not None
    shared = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(shared)
    monkeypatch.setenv("CI", ci)
    with pytest.raises(OUTCOMES, match="no render device: no driver") as caught:
        shared.without_renderer("no driver")
    assert type(caught.value).__name__ == outcome


@pytest.mark.parametrize(("ci", "tries"), [(None, 1), ("", 1), ("false", 1), ("true", 2), ("1", 2)])
def test_a_browser_that_could_not_be_had_is_tried_again_on_ci(tmp_path, ci, tries):
    """Debian, root, a mirror that does not answer."""
    programs = tmp_path / "bin"
    programs.mkdir()
    for name in ("dirname", "rm", "touch"):
        (programs / name).symlink_to(str(shutil.which(name)))
    for name, does in (("id", "echo 0"), ("grep", "exit 0"), ("apt-get", f"echo >>{tmp_path}/tried; exit 100")):
        (programs / name).write_text(f"#!/bin/bash\n{does}\n")
        (programs / name).chmod(0o755)
    environment = {"PATH": str(programs), "ROBOCAS_SETUP_PYTHON": str(tmp_path / "bin" / "python")}
    for number in (1, 2):
        command = ["/bin/bash", ROOT / "scripts" / "install_browser.sh"]
        env = environment if ci is None else {**environment, "CI": ci}
        done = subprocess.run(command, capture_output=True, text=True, check=True, env=env)
        assert ("no chromium" in done.stdout) == (number <= tries)
    assert len((tmp_path / "tried").read_text().splitlines()) == tries
