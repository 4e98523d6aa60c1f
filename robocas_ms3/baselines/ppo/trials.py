"""Where `ppo` tries: several environments that show and take what a policy is shown and may do in an evaluation."""

from __future__ import annotations

import hashlib
import json
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import VectorEnv
from gymnasium.vector.utils import batch_space

import robocas_ms3
from robocas_ms3.baselines.ppo.config import ONE_FRUIT, ONE_FRUIT_STEPS, PpoConfig
from robocas_ms3.core.errors import TrainingError
from robocas_ms3.scenes.config import TaskConfig, load_task_config
from robocas_ms3.scenes.task_specs import TASKS
from robocas_ms3.tasks.rl import CONTROL_FREQ

FIRST_TRIAL = 20_000  # first seed of the layouts that are not learned from
ACTED = 5


def arm_action(action: torch.Tensor) -> torch.Tensor:
    """Five numbers as seven of ``pd_ee_delta_pose``: the gripper keeps pointing as it did, and turns about that.

    1 is a shift by 5 cm, or a turn by 0.25 rad. The gripper is told to open or to close, as the evaluation's are.

    Args:
        action: (..., 5) shift along the TCP's axes, turn about its z, gripper; clipped to [-1, 1].
    """
    x, y, z, yaw, gripper = action.clip(-1, 1).unbind(-1)
    still = torch.zeros_like(x)
    told = torch.where(gripper > 0, 1.0, -1.0).to(x)
    return torch.stack([x / 2, y / 2, z / 2, still, still, yaw / 2, told], dim=-1)


def seen(qpos: Any, tcp_in_base: Any, gripper_width: Any, state: Any) -> torch.Tensor:
    """(N, O) of what `Observations` name: what the arm feels, and what only a simulator knows."""
    return torch.cat([torch.as_tensor(part).float() for part in (qpos, tcp_in_base, gripper_width, state)], dim=1)


class TopDown(gym.Wrapper):
    """Shows `seen` and takes `arm_action`'s five numbers; around one env, or a GPU's batch."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        base: Any = env.unwrapped
        size = _seen(base.get_obs(base.get_info())).shape[1]
        self.single_action_space = gym.spaces.Box(-1, 1, (ACTED,), np.float32)
        self.action_space = batch_space(self.single_action_space, base.num_envs)
        self.single_observation_space = gym.spaces.Box(-np.inf, np.inf, (size,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, base.num_envs)

    def reset(self, **kwargs: Any) -> tuple[torch.Tensor, dict[str, Any]]:
        """Reset; see ``BaseEnv``."""
        obs, info = self.env.reset(**kwargs)
        return _seen(obs), info

    def step(self, action: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """One step."""
        base: Any = self.unwrapped
        obs, *rest = self.env.step(arm_action(torch.as_tensor(action, device=base.device)))
        return (_seen(obs), *rest)  # pyright: ignore[reportReturnType]


def _seen(obs: dict[str, Any]) -> torch.Tensor:
    agent = obs["agent"]
    told = [value for name, value in obs["extra"].items() if name != "tcp_pose"]  # as `privileged` has it
    return seen(agent["qpos"], agent["tcp_in_arm_base"], agent["gripper_width"], torch.cat(told, dim=1))


class EnvTrials:
    """Environments to learn in; see `Trials`. A success does not end an episode, and each env keeps its objects.

    Args:
        config: which, and how many.
        device: ``cpu``: they are in processes; ``cuda``: in one batch.

    Raises:
        ConfigError: there is no such task or configuration.
        TrainingError: the base has to drive.
    """

    def __init__(self, config: PpoConfig, device: str) -> None:
        scenes = scenes_of(config)
        kwargs: dict[str, Any] = robocas_ms3.rl_kwargs(config.task, scenes) | {"obs_mode": "state_dict"}
        if kwargs["control_mode"] != "pd_ee_delta_pose":
            what = "the base drives in these scenes, which ppo does not"
            raise TrainingError(what, where=config.scenes or config.task, fix="Choose scenes without base_motion.")
        horizon = config.horizon or (ONE_FRUIT_STEPS if config.scenes is None else kwargs["max_episode_steps"])
        self._config, self._device = config, device
        self._kwargs: dict[str, Any] = kwargs | {"max_episode_steps": horizon}
        self.name = f"trials of {config.scenes or f'one fruit, {config.task}'}"
        said = {"task": config.task, "scenes": scenes.model_dump(mode="json"), "horizon": horizon}
        self.hash = hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()
        self.episodes = config.layouts
        self.envs = self.make(config.envs, 0, config.layouts - 1)
        shape = self.envs.single_observation_space.shape
        assert shape is not None
        self.facts: dict[str, Any] = {"observed": shape[0], "acted": ACTED, "rate_hz": CONTROL_FREQ, **said}

    def __len__(self) -> int:
        return self._config.train.steps

    def make(self, count: int, first_seed: int, last_seed: int) -> VectorEnv:
        """Environments whose layouts are those of some seeds."""
        return robocas_ms3.make_vec(
            next(spec.env_id for spec in TASKS.values() if self._config.task in (spec.name, spec.env_id)),
            count,
            backend="gpu" if self._device == "cuda" else "processes",
            workers=self._config.workers if self._device == "cpu" else None,
            wrappers=[TopDown],
            ignore_terminations=True,
            reconfiguration_freq=0,
            seeds=(first_seed, last_seed),
            **self._kwargs,
        )

    def close(self) -> None:
        """End them."""
        self.envs.close()


def scenes_of(config: PpoConfig) -> TaskConfig:
    """What is tried in.

    Raises:
        ConfigError: there is no such configuration.
    """
    if config.scenes is not None:
        return load_task_config(config.scenes)
    return load_task_config(load_task_config("pick_table_scattered").model_dump(mode="json") | ONE_FRUIT)
