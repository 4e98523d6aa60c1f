"""Run tests/gpu on the emulated GPU interface, in a separate process, as the emulation cannot be undone."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from gpu_emulation import unsupported_torch

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module", autouse=True)
def needs_supported_torch() -> None:
    """Skip the tests with an unsupported build of torch, or fail on CI, where setup.sh installs a supported one."""
    problem = unsupported_torch()
    if problem is not None and os.environ.get("CI", "").lower() in ("", "0", "false"):
        pytest.skip(problem)
    assert problem is None, problem


def run(*arguments: str) -> int:
    """Run tests/gpu on the emulation; return the number of passed tests."""
    path = os.pathsep.join(filter(None, [str(ROOT), str(ROOT / "tests/support"), os.environ.get("PYTHONPATH")]))
    command = [sys.executable, "-m", "pytest", "-q", "-p", "gpu_emulation.plugin", "-p", "no:cacheprovider"]
    done = subprocess.run(
        [*command, "tests/gpu", *arguments],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-8000:] + done.stderr[-2000:]
    passed = re.search(r"(\d+) passed", done.stdout)
    assert passed is not None, done.stdout[-2000:]
    return int(passed[1])


@pytest.mark.slow
def test_contracts_of_four_envs():
    assert run("-m", "gpu and not emulated_gpu_full") > 78


@pytest.mark.emulated_gpu_full
def test_everything_with_ten_envs():
    assert run("-m", "gpu or emulated_gpu_full", "--emulated-envs", "10") > 78
