"""Tasks of other packages are registered whatever is imported first, theirs or ours."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
MODULE = """
{first}
from robocas_ms3.scenes.task_specs import TaskSpec

SPEC = TaskSpec("juggle", "RoboCASJuggle-v1", "{module}:Env", "pick_table_scattered", "a:b", "c:d", 7, 7, "juggle")
{last}
"""
KNOWN = "import gymnasium; print('RoboCASJuggle-v1' in gymnasium.registry, 'RoboCASPick-v1' in gymnasium.registry)"


@pytest.fixture
def said(tmp_path):
    """What a program says where a package is installed whose entry point is this."""

    def run(code: str, point: str = "juggler:SPEC") -> str:
        info = tmp_path / "juggler-1.dist-info"
        info.mkdir()
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: juggler\nVersion: 1\n")
        (info / "entry_points.txt").write_text(f"[robocas_ms3.tasks]\njuggle = {point}\n")
        path = os.pathsep.join([str(tmp_path), str(ROOT), os.environ.get("PYTHONPATH", "")])
        command = [sys.executable, "-W", "ignore", "-c", code]
        done = subprocess.run(
            command, capture_output=True, text=True, check=False, env=os.environ | {"PYTHONPATH": path}
        )
        assert done.returncode == 0, done.stderr
        assert done.stderr == ""
        return done.stdout.strip()

    return run


@pytest.mark.parametrize("code", ["import juggler", "import gymnasium, juggler", "import robocas_ms3, gymnasium"])
@pytest.mark.parametrize("first", ["import robocas_ms3", "import robocas_ms3, gymnasium", "import robocas_ms3.tasks"])
def test_the_module_of_the_row_imports_this_package_first(said, tmp_path, code, first):
    (tmp_path / "juggler.py").write_text(MODULE.format(first=first, module="juggler", last=""))
    assert said(f"{code}; {KNOWN}") == "True True"


@pytest.mark.parametrize("code", ["import gymnasium, juggler", "import robocas_ms3, gymnasium"])
def test_the_package_of_the_row_imports_this_one_before_it_has_what_the_row_wants(said, tmp_path, code):
    folder = tmp_path / "juggler"
    folder.mkdir()
    (folder / "__init__.py").write_text("import robocas_ms3\nNAME = 'juggle'")
    (folder / "row.py").write_text(MODULE.format(first="from juggler import NAME", module="juggler.env", last=""))
    assert said(f"{code}; {KNOWN}", "juggler.row:SPEC") == "True True"


def test_it_may_want_what_this_package_offers_at_its_top(said, tmp_path):
    (tmp_path / "juggler.py").write_text(MODULE.format(first="from robocas_ms3 import make_vec", module="x", last=""))
    assert said(f"import gymnasium, robocas_ms3; {KNOWN}") == "True True"


def test_one_that_fails_in_the_middle_is_its_own_affair(said, tmp_path):
    (tmp_path / "juggler.py").write_text(MODULE.format(first="import robocas_ms3", module="x", last="raise OSError"))
    code = f"import gymnasium\ntry: import juggler\nexcept OSError: print('OSError')\n{KNOWN}"
    assert said(code).splitlines() == ["OSError", "False True"]
