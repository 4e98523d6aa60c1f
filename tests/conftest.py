"""Fixtures of all tests. Tests use a temporary data folder, and the cache folder of the user."""

from __future__ import annotations

import gc
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from functools import lru_cache
from pathlib import Path
from typing import NoReturn

import pytest
from hypothesis import settings

settings.register_profile("untimed", deadline=None)  # a busy machine is no failure
settings.load_profile("untimed")
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # under nohup, or behind a script's &: programs would inherit it
    signal.signal(signal.SIGINT, signal.default_int_handler)
ROOT = Path(__file__).resolve().parents[1]
PROBES = ROOT / "robocas_ms3" / "doctor" / "probes.py"
LONGEST = {
    "tests/asset_tools/test_bad_scans.py",
    "tests/asset_tools/builtin/test_builtin_furniture.py",
    "tests/asset_tools/builtin/test_builtin_shapes.py",
    "tests/datasets/conversion/test_env_renderer.py",
    "tests/demos/test_generate.py",
    "tests/evaluation/rollouts/test_weld.py",
    "tests/examples/test_examples.py",
    "tests/plans/test_run_plan.py",
    "tests/tasks/test_registry.py",
    "tests/tasks/vector/test_processes.py",
    "tests/tasks/vector/test_same_episodes.py",
    "tests/test_emulated_gpu.py",
    "tests/viewer/test_page.py",
}
"""Test files that take half a minute or more."""


def pytest_configure(config: pytest.Config) -> None:
    config.stash[_DATA] = tempfile.mkdtemp(prefix="robocas-test-data-")
    os.environ["ROBOCAS_DATA"] = config.stash[_DATA]


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Deselect tests marked `emulated_gpu_full` unless requested, and start with the longest files.

    Otherwise one process could run a long file at the end, while the others are idle.
    """
    if "emulated_gpu_full" not in (config.option.markexpr or ""):
        marked = [item for item in items if item.get_closest_marker("emulated_gpu_full")]
        long = [item for item in marked if not item.get_closest_marker("gpu")]
        config.hook.pytest_deselected(items=long)
        items[:] = [item for item in items if item not in long]
    items.sort(key=lambda item: item.nodeid.partition("::")[0] not in LONGEST)  # a stable sort


def pytest_collection_finish(session: pytest.Session) -> None:
    """Exclude imported modules from garbage collections, which take 0.3 s; ManiSkill runs one per closed env."""
    gc.freeze()


def pytest_unconfigure(config: pytest.Config) -> None:
    shutil.rmtree(config.stash[_DATA], ignore_errors=True)


_DATA = pytest.StashKey[str]()


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    """Return the folder of reference material: $ROBOCAS_SHARED, or `shared` next to the checkout."""
    folder = Path(os.environ.get("ROBOCAS_SHARED") or ROOT.parent / "shared")
    if not folder.is_dir():
        pytest.skip(f"no reference material: {folder} is not a folder (set ROBOCAS_SHARED)")
    return folder


@pytest.fixture(scope="session")
def needs_renderer() -> str:
    """Return the render device. Without one, skip the test, or fail it on CI, where setup.sh installs one."""
    device, problem = _render_device()
    if device is None:
        without_renderer(problem)
    return device


@pytest.fixture
def small_disk(tmp_path):
    """Mount a file system of 600 kB; skip the test if that is impossible."""
    folder = tmp_path / "small"
    folder.mkdir()
    done = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=600k", "tmpfs", str(folder)], check=False, capture_output=True, text=True
    )
    if done.returncode:
        pytest.skip(f"a full disk is not tested: tmpfs cannot be mounted: {done.stderr.strip()}")
    yield folder
    subprocess.run(["umount", "--lazy", str(folder)], check=True)


def without_renderer(problem: str) -> NoReturn:
    """Skip the test, or fail it on CI."""
    if os.environ.get("CI", "").lower() in ("", "0", "false"):
        pytest.skip(f"no render device: {problem}")
    pytest.fail(f"no render device: {problem}", pytrace=False)


@lru_cache
def _render_device() -> tuple[str | None, str]:
    done = subprocess.run([sys.executable, PROBES, "render"], capture_output=True, text=True, check=False)
    if done.returncode == 0:
        return done.stdout.strip(), ""
    return None, (done.stderr.strip().splitlines() or [f"exit status {done.returncode}"])[-1]
