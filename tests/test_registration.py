"""Importing the package registers all tasks with gymnasium, without loading a simulator."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import pytest

import robocas_ms3  # noqa: F401

ROOT = Path(__file__).resolve().parents[1]
ROW = """
import robocas_ms3
from robocas_ms3.scenes.task_specs import TaskSpec

SPEC = TaskSpec("juggle", "{env_id}", "juggler.env:Env", "pick_table_scattered", "a:b", "c:d", 7, 7, "juggle")
"""


def run(code: str, *folders: Path) -> subprocess.CompletedProcess[str]:
    path = os.pathsep.join([*map(str, folders), str(ROOT)])
    command = [sys.executable, "-W", "ignore", "-c", code]
    return subprocess.run(command, capture_output=True, text=True, check=True, env=os.environ | {"PYTHONPATH": path})


@pytest.fixture
def juggler(tmp_path):
    """Install a package whose entry point names a task; return its folder."""

    def install(row: str, point: str = "juggler.row:SPEC") -> Path:
        info, folder = tmp_path / "juggler-1.dist-info", tmp_path / "juggler"
        info.mkdir()
        folder.mkdir()
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: juggler\nVersion: 1\n")
        (info / "entry_points.txt").write_text(f"[robocas_ms3.tasks]\njuggle = {point}\n")
        (folder / "__init__.py").write_text("import robocas_ms3")
        (folder / "row.py").write_text(row)
        return tmp_path

    return install


@pytest.mark.parametrize("modules", ["robocas_ms3", "gymnasium, robocas_ms3", "robocas_ms3.scenes.task_specs"])
def test_importing_the_package_registers_its_tasks_and_loads_no_simulator(modules):
    code = f"import sys, {modules}, gymnasium; print(gymnasium.spec('RoboCASSearch-v1').max_episode_steps)"
    found = run(f"{code}; print(sorted({{'torch', 'mani_skill', 'sapien', 'pydantic'}} & set(sys.modules)))")
    assert found.stdout.split("\n")[:2] == ["2400", "[]"]


@pytest.mark.parametrize("first", ["robocas_ms3", "juggler"])
def test_a_task_of_another_package_is_registered(juggler, first):
    folder = juggler(ROW.format(env_id="RoboCASJuggle-v1"))
    found = run(f"import {first}, gymnasium; print(gymnasium.spec('RoboCASJuggle-v1').max_episode_steps)", folder)
    assert (found.stdout.strip(), found.stderr) == ("140", "")


@pytest.mark.parametrize(
    ("row", "point", "fault"),
    [
        ("raise OSError('gone')", "juggler.row:SPEC", "OSError: gone"),
        (ROW.format(env_id="no id"), "juggler.row:SPEC", "juggle can't be registered"),
        ("", "juggler.nothing:SPEC", "juggler.nothing"),
    ],
)
def test_a_broken_task_of_another_package_is_a_warning(juggler, row, point, fault):
    found = run("import robocas_ms3, gymnasium; gymnasium.spec('RoboCASPick-v1')", juggler(row, point))
    assert fault in found.stderr
    assert len(found.stderr.splitlines()) == 1


def test_an_id_that_is_registered_already_stays(juggler):
    folder = juggler(ROW.format(env_id="RoboCASPick-v1"))
    assert run("import robocas_ms3, gymnasium; print(gymnasium.spec('RoboCASPick-v1').max_episode_steps)", folder)


def test_make_accepts_a_time_limit_and_returns_tensors():
    kwargs = {"obs_mode": "none", "control_mode": "pd_joint_delta_pos", "render_backend": "none"}
    env = gym.make("RoboCASPick-v1", max_episode_steps=2, **kwargs)
    env.reset(seed=0)
    found = [env.step(env.action_space.sample())[3] for _ in range(2)]
    assert [truncated.tolist() for truncated in found] == [[False], [True]]
    env.close()


def test_importing_the_tasks_registers_them_with_mani_skill():
    from mani_skill.agents.registration import REGISTERED_AGENTS
    from mani_skill.utils.registration import REGISTERED_ENVS

    from robocas_ms3.tasks import TASKS

    assert {spec.env_id for spec in TASKS.values()} <= set(REGISTERED_ENVS)
    assert "robocas_mobile_panda" in REGISTERED_AGENTS
