"""The setup scripts: quick and silent when there is nothing to do, clear when they can't, no host of their own."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"


def bash(script: str, **environment: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        ["bash", "-euo", "pipefail", "-c", script],
        capture_output=True,
        text=True,
        env=os.environ | environment,
        check=False,
    )


def test_no_script_names_a_host():
    for path in SCRIPTS.iterdir():
        if path.is_file():
            assert not re.search(r"://(?!127\.0\.0\.1)", path.read_text()), path.name


@pytest.mark.parametrize(("option", "newest"), [("", "3.13"), ("--lerobot", "3.12")])
def test_missing_interpreter(option, newest):
    command = f"bash {SCRIPTS / 'setup.sh'} {option}"
    done = bash(command, ROBOCAS_VENV="/nonexistent/venv", ROBOCAS_PYTHON="no-such-python")
    assert done.returncode == 1
    assert newest in done.stderr
    assert "no-such-python" in done.stderr


def test_unknown_option_of_setup():
    done = bash(f"bash {SCRIPTS / 'setup.sh'} --gpu")
    assert done.returncode == 2
    assert "usage" in done.stderr


def test_nothing_to_do_is_silent(needs_renderer):
    if not Path(sys.prefix, ".robocas-setup").is_file():
        pytest.skip("these tests don't run in an environment made by setup.sh")
    command = f"bash {SCRIPTS / 'setup.sh'}"
    assert bash(command, ROBOCAS_VENV=sys.prefix).returncode == 0
    done = bash(command, ROBOCAS_VENV=sys.prefix)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_no_renderer_and_no_root_is_one_line_and_no_failure(tmp_path):
    fake = tmp_path / "bin" / "python"
    fake.parent.mkdir()
    fake.write_text("#!/bin/sh\nexit 1\n")
    identity = tmp_path / "bin" / "id"
    identity.write_text("#!/bin/sh\necho 1000\n")
    for path in (fake, identity):
        path.chmod(0o755)
    done = bash(
        f"bash {SCRIPTS / 'install_renderer.sh'}",
        ROBOCAS_SETUP_PYTHON=str(fake),
        PATH=f"{fake.parent}:{os.environ['PATH']}",
    )
    assert done.returncode == 0
    assert len(done.stdout.splitlines()) == 1
    assert "mesa-vulkan-drivers" in done.stdout
