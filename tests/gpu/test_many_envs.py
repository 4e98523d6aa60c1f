"""Contracts of many envs on a GPU. Without a CUDA device all of it is skipped; `scripts/gpu_checks.sh` runs it."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

import robocas_ms3  # noqa: F401
from robocas_ms3.cli.layouts import Build, Layouts, main
from robocas_ms3.scenes.table import State
from robocas_ms3.tasks import TASKS
from robocas_ms3.tasks.starts import Starts

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device: unproven on a GPU"),
]

ENVS = 16
STILL = 0.003  # m in a second, of what a layout calls at rest


@pytest.fixture(params=sorted(TASKS), scope="module")
def many(request):
    made = gym.make(TASKS[request.param].env_id, num_envs=ENVS, obs_mode="state", render_backend="none")
    yield made
    made.close()


def moved(env: gym.Env, seed: int, count: int) -> None:
    """Some random motions of every arm."""
    base: Any = env.unwrapped
    generator = torch.Generator(base.device).manual_seed(seed)
    rest = base.agent.robot.get_qpos()[:, 3:10]
    for _ in range(count):
        arm = rest + 0.1 * torch.randn(rest.shape, generator=generator, device=base.device)
        env.step(torch.cat([arm, torch.ones(len(arm), 1, device=base.device)], dim=1))


@pytest.mark.parametrize("name", sorted(TASKS))
@pytest.mark.parametrize("count", [16, 256])
def test_contract(name, count):
    env = gym.make(TASKS[name].env_id, num_envs=count, obs_mode="state", render_backend="none")
    base: Any = env.unwrapped
    states = []
    for _ in range(2):
        observation, info = env.reset(seed=0)
        assert observation.shape[0] == count
        moved(env, 0, 3)
        states.append(base.get_state().clone())
    torch.testing.assert_close(*states, atol=1e-4, rtol=0)  # a GPU adds up in any order
    observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
    for value in (observation, reward, terminated, truncated, *info.values()):
        if isinstance(value, torch.Tensor):
            assert value.device == base.device
            assert len(value) == count
            assert torch.isfinite(value.float()).all()
    assert info["success"].dtype == torch.bool
    assert not info["success"].any()
    env.close()


@pytest.mark.parametrize("name", sorted(TASKS))
def test_scenes_are_those_of_a_cpu(name):
    env = gym.make(TASKS[name].env_id, num_envs=8, obs_mode="none", render_backend="none", seeds=(0, 7))
    one = gym.make(TASKS[name].env_id, obs_mode="none", render_backend="none")
    base: Any = env.unwrapped
    alone: Any = one.unwrapped
    env.reset(seed=list(range(8)))
    for seed in range(8):
        one.reset(seed=seed)
        assert [a.asset.id for a in base.object_assets[seed]] == [a.asset.id for a in alone.object_assets[0]]
        torch.testing.assert_close(base.object_poses[seed].cpu(), alone.object_poses[0], atol=1e-4, rtol=0)
        torch.testing.assert_close(base.basket_pose[seed].cpu(), alone.basket_pose[0], atol=1e-4, rtol=0)
        assert int(base.target_slot[seed]) == int(alone.target_slot[0])
        assert base.get_language_instruction()[seed] == alone.get_language_instruction()[0]
    env.close()
    one.close()


def test_what_is_at_rest_stays(many):
    base: Any = many.unwrapped
    many.reset(seed=0)
    before = base.object_poses.clone()
    rest = torch.cat([base.agent.robot.get_qpos()[:, 3:10], torch.ones(ENVS, 1, device=base.device)], dim=1)
    for _ in range(base.control_freq):
        many.step(rest)
    shift = (base.object_poses - before)[..., :3].norm(dim=-1).where(base.present, 0.0)
    assert shift.max() < STILL


def test_a_partial_reset_leaves_the_other_envs_alone(many):
    base: Any = many.unwrapped
    many.reset(seed=0)
    moved(many, 1, 10)
    before, targets = base.bodies.read().clone(), base.agent.controller_targets()
    some = torch.tensor([1, 4, 5], device=base.device)
    many.reset(options={"env_idx": some})
    others = torch.tensor([i for i in range(ENVS) if i not in (1, 4, 5)], device=base.device)
    # written back and read again, by way of centres of mass
    torch.testing.assert_close(base.bodies.read()[others], before[others], atol=1e-5, rtol=0)
    assert not torch.equal(base.bodies.read()[some], before[some])
    for name, found in base.agent.controller_targets().items():
        for key, value in found.items():
            assert torch.equal(value[others], targets[name][key][others])
    assert (base.elapsed_steps[some] == 0).all()
    assert (base.elapsed_steps[others] == 10).all()


@pytest.mark.parametrize("mode", ["pd_joint_pos", "pd_ee_delta_pose"])
def test_a_state_is_come_back_to(mode):
    env = gym.make("RoboCASPick-v1", num_envs=8, obs_mode="none", control_mode=mode, render_backend="none")
    base: Any = env.unwrapped
    env.reset(seed=0)
    size = env.action_space.shape[-1]
    generator = torch.Generator(base.device).manual_seed(0)

    def play() -> torch.Tensor:
        start = base.agent.robot.get_qpos()[:, 3:10] if size == 8 else None
        for _ in range(10):
            noise = 0.1 * torch.randn(8, size, generator=generator, device=base.device)
            if start is not None:
                noise[:, :7] += start
            env.step(noise)
        return base.agent.robot.get_qpos().clone()

    play()
    kept, kept_generator = base.get_state_dict(), generator.get_state()
    after = play()
    base.set_state_dict(kept)
    generator.set_state(kept_generator)
    assert (play() - after).abs().max() < 1e-4
    env.close()


def test_heaps_are_tried_by_this_engine_and_resets_gather_what_stays(tmp_path):
    command = Build("search_table_small_heap", objects="0:4", seeds="0:4", jobs=2, out=tmp_path, engine="gpu")
    assert main(Layouts(command)) == 0
    made = gym.make(
        "RoboCASSearch-v1",
        config="search_table_small_heap",
        num_envs=8,
        layouts=tmp_path,
        seeds=(0, 3),
        obs_mode="none",
        render_backend="none",
    )
    env: Any = made.unwrapped
    assert env._tabled is not None
    assert not env._table.pairs(State.UNTRIED)
    tried = {state: len(env._table.pairs(state)) for state in (State.STAYS, State.MOVES)}
    assert sum(tried.values()) == 16
    assert tried[State.MOVES] <= 4, tried
    for _ in range(5):
        made.reset()
        assert env.object_poses.device == env.device
        for i in (0, 7):
            wanted = Starts.of([env.layout(i)], env.device).object_poses[0]
            torch.testing.assert_close(env.object_poses[i], wanted, atol=1e-4, rtol=0)
    made.close()


def test_contact_buffers_hold_what_256_heaps_need():
    env = gym.make("RoboCASSearch-v1", num_envs=256, obs_mode="none", render_backend="none")
    env.reset(seed=0)
    moved(env, 0, 40)  # an overflow would be an error of ours
    env.close()


def test_cameras_see_something():
    size = dict(width=64, height=48)
    env = gym.make("RoboCASPick-v1", num_envs=4, obs_mode="rgb", sensor_configs=size)
    observation, _ = env.reset(seed=0)
    for camera in observation["sensor_data"].values():
        picture = camera["rgb"].float().cpu().numpy()
        assert picture.shape == (4, 48, 64, 3)
        assert np.ptp(picture) > 50
    env.close()
