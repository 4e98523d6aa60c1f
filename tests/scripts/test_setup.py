"""The setup scripts: quick and silent when there is nothing to do, clear when they can't, no host of their own."""

import os
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"

DEB822 = """\
# comment
Types: deb-src
URIs: http://sources.example/debian
Suites: bookworm

Types: deb
# a snapshot
URIs: http://mirror.example/debian
Suites: bookworm bookworm-updates
Components: main
Signed-By: /usr/share/keyrings/archive.gpg

Types: deb
URIs: http://mirror.example/debian-security
Suites: bookworm-security
Components: main
"""
ONE_LINE = """\
# deb http://old.example/debian bookworm main
deb-src http://sources.example/debian bookworm main
deb [arch=amd64 signed-by=/usr/share/keyrings/archive.gpg] http://mirror.example/debian bookworm main
deb http://mirror.example/debian-security bookworm-security main
"""


def bash(script: str, **environment: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        ["bash", "-euo", "pipefail", "-c", script],
        capture_output=True,
        text=True,
        env=os.environ | environment,
        check=False,
    )


def archive_of(suite: str, apt: Path) -> str:
    source = (SCRIPTS / "install_renderer.sh").read_text()
    function = re.search(r"^archive_of\(\) \{.*?^\}", source, re.MULTILINE | re.DOTALL)
    assert function
    return bash(function[0].replace("/etc/apt", str(apt)) + f"\narchive_of {suite} || true").stdout.strip()


@pytest.mark.parametrize(("file", "content"), [("sources.list.d/debian.sources", DEB822), ("sources.list", ONE_LINE)])
def test_mirror_and_key_come_from_the_machines_own_sources(tmp_path, file, content):
    (tmp_path / "sources.list.d").mkdir()
    (tmp_path / file).write_text(content)
    assert archive_of("bookworm", tmp_path) == "http://mirror.example/debian\t/usr/share/keyrings/archive.gpg"
    assert archive_of("bookworm-security", tmp_path) == "http://mirror.example/debian-security\t-"
    assert archive_of("bookworm-backports", tmp_path) == ""


def test_no_sources_are_no_mirror(tmp_path):
    (tmp_path / "sources.list.d").mkdir()
    assert archive_of("bookworm", tmp_path) == ""


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


def test_nothing_to_do_is_quick_and_silent(needs_renderer):
    if not Path(sys.prefix, ".robocas-setup").is_file():
        pytest.skip("these tests don't run in an environment made by setup.sh")
    command = f"bash {SCRIPTS / 'setup.sh'}"
    assert bash(command, ROBOCAS_VENV=sys.prefix).returncode == 0
    start = time.perf_counter()
    done = bash(command, ROBOCAS_VENV=sys.prefix)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert time.perf_counter() - start < 5


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
