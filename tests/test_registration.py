"""What importing the package does: gymnasium knows the tasks, and nothing heavy is loaded."""

import subprocess
import sys

import pytest

ASK = "print(gymnasium.spec('RoboCASSearch-v1').max_episode_steps, 'mani_skill' in sys.modules)"


def output(code: str) -> str:
    command = [sys.executable, "-W", "ignore", "-c", f"import sys; {code}"]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


@pytest.mark.parametrize("modules", ["gymnasium, robocas_ms3", "robocas_ms3, gymnasium", "robocas_ms3.cli, gymnasium"])
def test_gymnasium_is_told_of_the_tasks_in_either_order_and_no_simulator_is_loaded(modules):
    assert output(f"import {modules}; {ASK}") == "2400 False"


@pytest.mark.parametrize("first", ["robocas_ms3.registration", "robocas_ms3.tasks"])
def test_whatever_of_the_package_is_imported_before_gymnasium(first):
    assert output(f"import {first}, gymnasium; {ASK}") == f"2400 {first == 'robocas_ms3.tasks'}"


def test_importing_the_package_alone_loads_nothing():
    heavy = {"gymnasium", "numpy", "torch", "mani_skill", "pydantic"}
    assert output(f"import robocas_ms3; print(sorted({heavy!r} & set(sys.modules)))") == "[]"


def test_a_missing_gymnasium_is_missing_for_who_wants_it():
    code = "sys.path = [p for p in sys.path if 'site-packages' not in p]; import robocas_ms3\n"
    code += "try: import gymnasium\nexcept ModuleNotFoundError as error: print(error)"
    assert output(code) == "No module named 'gymnasium'"


def test_loading_the_tasks_tells_mani_skill():
    from mani_skill.agents.registration import REGISTERED_AGENTS
    from mani_skill.utils.registration import REGISTERED_ENVS

    from robocas_ms3.tasks import TASKS

    assert {spec.env_id for spec in TASKS.values()} <= set(REGISTERED_ENVS)
    assert "robocas_mobile_panda" in REGISTERED_AGENTS
