"""Programs of the docs that run as they are printed, each in a process of its own."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

DOCS = Path(__file__).resolve().parents[2] / "docs"
pytestmark = pytest.mark.slow


def run_first_program(page: str, cwd: Path) -> list[str]:
    """What the first Python program of a page prints."""
    found = re.search(r"^```python\n(.*?)^```", (DOCS / page).read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    assert found, f"{page} has no program"
    path = cwd / "program.py"
    path.write_text(found[1], encoding="utf-8")
    done = subprocess.run(
        [sys.executable, str(path)], cwd=cwd, env=os.environ, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_batched(tmp_path):
    about, *ends = run_first_program("batched.md", tmp_path)
    assert about.startswith("torch.Size([4, 126]) grasp the ")
    assert ends == ["4 ended, 0.0 succeeded"] * 2
