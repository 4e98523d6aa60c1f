"""Programs of the docs that run as they are printed, each in a process of its own."""

import re
from functools import cache
from pathlib import Path

import pytest
from forkserver import ForkServer

DOCS = Path(__file__).resolve().parents[2] / "docs"
pytestmark = pytest.mark.slow


def programs(page: str) -> list[str]:
    """The Python programs of a page."""
    return re.findall(r"^```python\n(.*?)^```", (DOCS / page).read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


def run_first_program(page: str, cwd: Path) -> list[str]:
    """What the first Python program of a page prints."""
    assert programs(page), f"{page} has no program"
    return run_program(programs(page)[0], cwd)


@cache
def server() -> ForkServer:
    return ForkServer()


def run_program(program: str, cwd: Path) -> list[str]:
    """What a program prints."""
    path = cwd / "program.py"
    path.write_text(program, encoding="utf-8")
    done = server().run(path, cwd=cwd)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_batched(tmp_path):
    about, *ends = run_first_program("batched.md", tmp_path)
    assert about.startswith("torch.Size([4, 142]) grasp the ")
    assert ends == ["4 ended, 0.0 succeeded"] * 2


def test_motion_planning(needs_renderer, tmp_path):
    *_, end = run_first_program("motion_planning.md", tmp_path)
    assert end.startswith("success True after ")


def test_reinforcement_learning(tmp_path):
    rewards = [float(line.split()[0]) for line in run_first_program("rl.md", tmp_path)]
    assert len(rewards) == 5
    assert rewards == sorted(rewards)
    assert 0 < rewards[0] < rewards[-1] < 0.4


def test_stable_baselines(tmp_path):
    pytest.importorskip("stable_baselines3")
    _, program = programs("rl.md")
    assert "learn(100_000)" in program
    run_program(program.replace("100_000", "300"), tmp_path)
