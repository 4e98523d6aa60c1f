"""Fake batch of several envs on a GPU, which has seeds and layouts but no simulator."""

from typing import NamedTuple
from unittest.mock import Mock

import torch
from mani_skill.envs.sapien_env import BaseEnv
from sapien import physx

from robocas_ms3.tasks import RoboCASPickEnv


def make_batch_env(folder, monkeypatch, num_envs=4, **arguments) -> tuple[RoboCASPickEnv, list]:
    """Return a batch of pick envs without a simulator, and a list of the seed pairs of each reset."""
    asked = []

    def fake_reset(env, seed=None, options=None):
        index = torch.as_tensor((options or {}).get("env_idx", range(num_envs)))
        env._set_episode_rng(seed, index)
        if (options or {}).get("reconfigure"):
            env.seeds.choose_objects(env._episode_seed, env.device, on_gpu=True)
            env._set_episode_rng(env._episode_seed, index)
        env.seeds.forget_layouts(index.numpy())
        env.layouts = [env.layout(i) for i in index.tolist()]
        asked.append([(int(env.seeds.objects_seeds[i]), int(env.seeds.layout_seeds[i])) for i in index])
        return {}, {}

    def fake_init(env, *args, num_envs, **rest):
        env.num_envs, env._enhanced_determinism, env._batched_rng_backend = num_envs, False, "numpy:random_state"
        env._episode_seed, env._batched_episode_rng = None, None
        env.reset([2022 + i for i in range(num_envs)], {"reconfigure": True})  # as ManiSkill does

    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(physx, "enable_gpu", lambda: None)
    monkeypatch.setattr(BaseEnv, "_sim_device", Mock(is_cuda=lambda: True), raising=False)
    monkeypatch.setattr(BaseEnv, "device", torch.device("cpu"), raising=False)
    monkeypatch.setattr(BaseEnv, "__init__", fake_init)
    monkeypatch.setattr(BaseEnv, "reset", fake_reset)
    return RoboCASPickEnv(num_envs=num_envs, layouts=folder, **arguments), asked


class FakeLayout(NamedTuple):
    """Fake layout that stores its seeds."""

    objects: int
    seed: int

    @property
    def object_ids(self) -> tuple[str, ...]:
        return (f"thing {self.objects}",)
