"""Contracts of a batch of envs, on a GPU (`scripts/gpu_checks.sh`) or on its emulated interface."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from batches import check_partial_reset, check_state_round_trip, make_batch, set_control_mode
from gpu_emulation import emulated_envs

import robocas_ms3  # noqa: F401
from robocas_ms3.cli.layouts import Build, build
from robocas_ms3.scenes.layout_table import LayoutStatus
from robocas_ms3.tasks import TASKS
from robocas_ms3.tasks.initial_states import InitialStates

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device: unproven on a GPU"),
]

ENVS = emulated_envs() or 16
SOME = [1, 3]  # envs of a partial reset
MODES = ["pd_joint_pos", "pd_ee_delta_pose"]
STILL = 0.003  # m per second, greatest shift of an object at rest
only_gpu = pytest.mark.skipif(emulated_envs() > 0, reason="the emulation has no limits of memory")


@pytest.fixture(params=sorted(TASKS), scope="module")
def many(request):
    made = make_batch(request.param, ENVS, obs_mode="state")
    yield made
    made.close()


def moved(env: gym.Env, seed: int, count: int) -> None:
    """Move each arm by random actions."""
    base: Any = env.unwrapped
    generator = torch.Generator().manual_seed(seed)
    rest = base.agent.robot.get_qpos()[:, 3:10]
    for _ in range(count):
        arm = rest + 0.1 * torch.randn(rest.shape, generator=generator).to(base.device)
        env.step(torch.cat([arm, torch.ones(len(arm), 1, device=base.device)], dim=1))


@pytest.mark.parametrize("name", sorted(TASKS))
@pytest.mark.parametrize("count", [emulated_envs()] if emulated_envs() else [16, 256])
def test_contract(name, count):
    env = gym.make(TASKS[name].env_id, num_envs=count, obs_mode="state", render_backend="none")
    base: Any = env.unwrapped
    states = []
    for _ in range(3):  # PhysX keeps contacts over a reset: the first one with a seed differs from later ones
        observation, info = env.reset(seed=0)
        assert observation.shape[0] == count
        moved(env, 0, 3)
        states.append(base.get_state().clone())
    torch.testing.assert_close(*states[1:], atol=1e-4, rtol=0)  # a GPU sums in any order
    observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
    for value in (observation, reward, terminated, truncated, *info.values()):
        if isinstance(value, torch.Tensor):
            assert value.is_cuda
            assert len(value) == count
            assert torch.isfinite(value.float()).all()
    assert info["success"].dtype == torch.bool
    assert not info["success"].any()
    env.close()


@pytest.mark.parametrize("name", sorted(TASKS))
def test_scenes_equal_those_on_a_cpu(name):
    count = emulated_envs() or 8
    env = make_batch(name, count, obs_mode="none")
    one = gym.make(TASKS[name].env_id, obs_mode="none", render_backend="none", sim_backend="physx_cpu")
    base: Any = env.unwrapped
    alone: Any = one.unwrapped
    env.reset(seed=list(range(count)))
    for seed in range(count):
        one.reset(seed=seed)
        assert [a.asset.id for a in base.object_assets[seed]] == [a.asset.id for a in alone.object_assets[0]]
        torch.testing.assert_close(base.object_poses[seed].cpu(), alone.object_poses[0], atol=1e-4, rtol=0)
        torch.testing.assert_close(base.basket_pose[seed].cpu(), alone.basket_pose[0], atol=1e-4, rtol=0)
        assert int(base.target_slot[seed]) == int(alone.target_slot[0])
        assert base.get_language_instruction()[seed] == alone.get_language_instruction()[0]
    env.close()
    one.close()


def test_objects_at_rest_are_stable(many):
    base: Any = many.unwrapped
    many.reset(seed=0)
    before = base.object_poses.clone()
    rest = torch.cat([base.agent.robot.get_qpos()[:, 3:10], torch.ones(ENVS, 1, device=base.device)], dim=1)
    for _ in range(base.control_freq):
        many.step(rest)
    shift = (base.object_poses - before)[..., :3].norm(dim=-1).where(base.present, 0.0)
    assert shift.max() < STILL


@pytest.mark.parametrize("mode", MODES)
def test_partial_reset_leaves_other_envs_unchanged(many, mode):
    """Exactly equal on the emulation; a GPU rounds differently."""
    set_control_mode([many], mode)
    check_partial_reset(many, SOME, mode, exact=emulated_envs() > 0)


@pytest.mark.parametrize("mode", MODES)
def test_setting_a_state_restores_it(many, mode):
    set_control_mode([many], mode)
    check_state_round_trip(many, SOME, mode)


def test_heaps_are_checked_by_this_engine_and_resets_use_stable_ones(tmp_path):
    count = 2 if emulated_envs() else 4
    pairs = dict(objects=f"0:{count}", seeds=f"0:{count}")
    command = Build("search_table_small_heap", **pairs, jobs=2, out=tmp_path, engine="gpu")
    assert build(command) == 0
    made = gym.make(
        "RoboCASSearch-v1",
        config="search_table_small_heap",
        num_envs=ENVS,
        layouts=tmp_path,
        seeds=(0, count - 1),
        obs_mode="none",
        render_backend="none",
    )
    env: Any = made.unwrapped
    assert env.seeds.initial_state_table is not None
    assert not env.seeds.table.find_pairs(LayoutStatus.UNCHECKED)
    tried = {state: len(env.seeds.table.find_pairs(state)) for state in (LayoutStatus.STABLE, LayoutStatus.UNSTABLE)}
    assert sum(tried.values()) == count * count
    assert tried[LayoutStatus.UNSTABLE] <= count, tried
    for _ in range(5):
        made.reset()
        assert env.object_poses.is_cuda
        for i in (0, ENVS - 1):
            wanted = InitialStates.from_layouts([env.layout(i)], env.device).object_poses[0]
            torch.testing.assert_close(env.object_poses[i], wanted, atol=1e-4, rtol=0)
    made.close()


@only_gpu
def test_contact_buffers_are_large_enough_for_256_heaps():
    env = gym.make("RoboCASSearch-v1", num_envs=256, obs_mode="none", render_backend="none")
    env.reset(seed=0)
    moved(env, 0, 40)  # an overflow would raise a SimulationError
    env.close()


@pytest.mark.emulated_gpu_full
def test_cameras_render_images():
    size = dict(width=64, height=48)
    env = gym.make("RoboCASPick-v1", num_envs=4, obs_mode="rgb", sensor_configs=size)
    observation, _ = env.reset(seed=0)
    for camera in observation["sensor_data"].values():
        image = camera["rgb"].float().cpu().numpy()
        assert image.shape == (4, 48, 64, 3)
        assert np.ptp(image) > 50
    env.close()
