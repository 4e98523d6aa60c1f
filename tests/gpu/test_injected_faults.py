"""The checks of batches fail where a fault of batched code is injected; on the emulated GPU interface."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from batches import check_equals_singles, check_partial_reset, make_batch, make_singles, set_control_mode
from gpu_emulation import emulated_envs
from mani_skill.agents.controllers.base_controller import CombinedController
from mani_skill.envs.scene import ManiSkillScene

from robocas_ms3.robots.agent import MobileManipulator
from robocas_ms3.robots.joint_controllers import RobotController
from robocas_ms3.tasks import success
from robocas_ms3.tasks.bodies import Bodies
from robocas_ms3.tasks.seeds import EpisodeSeeds
from robocas_ms3.tasks.starts import Starts

MODE = "pd_joint_pos"

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(emulated_envs() == 0, reason="faults are injected on the emulated GPU interface"),
]


@pytest.fixture(scope="module")
def singles():
    envs = make_singles("pick", emulated_envs(), control_mode=MODE)
    yield envs
    for env in envs:
        env.close()


@pytest.fixture
def batch():
    env = make_batch("pick", emulated_envs(), control_mode=MODE)
    yield env
    env.close()


def check(batch: Any, singles: Any) -> None:
    check_equals_singles(batch, singles, MODE, steps=5)


def test_without_a_fault_the_checks_pass(batch, singles):
    check(batch, singles)
    check_partial_reset(batch, [1, 3], MODE)


@pytest.mark.parametrize("name", ["rigid_dynamic_data", "articulation_qpos", "articulation_target_position"])
def test_a_missing_apply(batch, singles, monkeypatch, name):
    monkeypatch.setattr(type(batch.unwrapped.scene.px), f"gpu_apply_{name}", lambda self: None)
    with pytest.raises(AssertionError):
        check(batch, singles)


def test_a_missing_apply_of_target_velocities(batch, singles, monkeypatch):
    """Only end-effector modes set them."""
    mode = "pd_ee_delta_pose"
    set_control_mode([batch, *singles], mode)
    check_equals_singles(batch, singles, mode, steps=5)
    monkeypatch.setattr(type(batch.unwrapped.scene.px), "gpu_apply_articulation_target_velocity", lambda self: None)
    with pytest.raises(AssertionError, match="qpos"):
        check_equals_singles(batch, singles, mode, steps=5)
    set_control_mode(singles, MODE)


def test_a_missing_fetch(batch, singles, monkeypatch):
    def forget(scene: Any) -> None:
        scene._needs_fetch = False

    monkeypatch.setattr(ManiSkillScene, "_gpu_fetch_all", forget)
    with pytest.raises(AssertionError):
        check(batch, singles)


@pytest.mark.parametrize("field", ["object_poses", "targets", "present"])
def test_a_cpu_tensor_mixed_in(batch, monkeypatch, field):
    gather = EpisodeSeeds.find_starts

    def mixed(seeds: Any, envs: Any) -> Starts:
        starts = gather(seeds, envs)
        return Starts(**{**starts.__dict__, field: getattr(starts, field).cpu()})

    monkeypatch.setattr(EpisodeSeeds, "find_starts", mixed)
    with pytest.raises(RuntimeError, match="same device"):
        batch.reset(seed=0)


def test_an_array_of_numpy_mixed_in(batch, monkeypatch):
    monkeypatch.setattr(success, "native", lambda tensor: tensor.numpy())
    with pytest.raises(RuntimeError, match="numpy"):
        batch.reset(seed=0)


def test_a_controller_reset_of_all_envs(batch, monkeypatch):
    monkeypatch.setattr(RobotController, "reset", CombinedController.reset)
    with pytest.raises(AssertionError, match="target_qpos of another env"):
        check_partial_reset(batch, [1, 3], MODE)


def test_swapped_objects(batch, singles, monkeypatch):
    put = Bodies.put_objects
    monkeypatch.setattr(Bodies, "put_objects", lambda self, envs, *rest: put(self, envs.flip(0), *rest))
    with pytest.raises(AssertionError, match="objects after the reset"):
        check(batch, singles)


def test_swapped_actions(batch, singles, monkeypatch):
    act = MobileManipulator.set_action

    def swapped(agent: Any, action: torch.Tensor) -> None:
        act(agent, action.flip(0) if agent.scene.gpu_sim_enabled else action)

    monkeypatch.setattr(MobileManipulator, "set_action", swapped)
    with pytest.raises(AssertionError, match="qpos"):
        check(batch, singles)


def test_swapped_observed_states(batch, singles, monkeypatch):
    gather = Bodies._gather
    monkeypatch.setattr(Bodies, "_gather", lambda self: gather(self).roll(1, 0))
    with pytest.raises(AssertionError, match="objects after the reset"):
        check(batch, singles)
