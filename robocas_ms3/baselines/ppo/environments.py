"""Training environments of `ppo`. Observations and actions are those of its policy in an evaluation."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import VectorEnv
from gymnasium.vector.utils import batch_space

import robocas_ms3
from robocas_ms3.baselines.ppo.config import ONE_FRUIT, ONE_FRUIT_STEPS, PpoConfig
from robocas_ms3.baselines.training.scenes import TrainingScenes, select_scene_settings
from robocas_ms3.core.errors import TrainingError
from robocas_ms3.robots.quantities import GRIPPER_WIDTH
from robocas_ms3.scenes.config import TaskConfig, load_task_config
from robocas_ms3.scenes.task_specs import TASKS
from robocas_ms3.tasks.rl import CONTROL_FREQ

FIRST_TEST_SEED = 20_000  # of test layouts; the training has only smaller seeds
ACTION_SIZE = 5


def expand_action(action: torch.Tensor) -> torch.Tensor:
    """Expand 5-D actions to 7-D actions of ``pd_ee_delta_pose``, which do not tilt the gripper.

    Args:
        action: (..., 5) translation along the TCP axes (1 = 5 cm), rotation about the TCP's z axis (1 = 0.25 rad), and
            gripper command (above 0: open). Values are clipped to [-1, 1].

    Returns:
        Actions (..., 7) in the range of ``pd_ee_delta_pose``, [-1, 1]. The gripper command is -1 or 1.
    """
    x, y, z, yaw, gripper = action.clip(-1, 1).unbind(-1)
    zero = torch.zeros_like(x)
    command = torch.where(gripper > 0, 1.0, -1.0).to(x)
    return torch.stack([x / 2, y / 2, z / 2, zero, zero, yaw / 2, command], dim=-1)


def join_observation(qpos: Any, tcp_in_base: Any, width: Any, state: Any) -> torch.Tensor:
    """Return observations (N, O) float32: proprioception, then the privileged state.

    qpos: (N, joints) joint positions. tcp_in_base: (N, 7) TCP pose in the arm's base frame. width: (N, 1) gripper
    width, m. state: (N, D) privileged state.
    """
    return torch.cat([torch.as_tensor(part).float() for part in (qpos, tcp_in_base, width, state)], dim=1)


class TopDownActionWrapper(gym.Wrapper):
    """Wrapper with the actions of `expand_action` and the observations of `join_observation`.

    It wraps one environment, or a batch of environments on a GPU.
    """

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        base: Any = env.unwrapped
        size = _make_observation(base.get_obs(base.get_info())).shape[1]
        self.single_action_space = gym.spaces.Box(-1, 1, (ACTION_SIZE,), np.float32)
        self.action_space = batch_space(self.single_action_space, base.num_envs)
        self.single_observation_space = gym.spaces.Box(-np.inf, np.inf, (size,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, base.num_envs)

    def reset(self, **kwargs: Any) -> tuple[torch.Tensor, dict[str, Any]]:
        obs, info = self.env.reset(**kwargs)
        return _make_observation(obs), info

    def step(self, action: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        base: Any = self.unwrapped
        obs, *rest = self.env.step(expand_action(torch.as_tensor(action, device=base.device)))
        return (_make_observation(obs), *rest)  # pyright: ignore[reportReturnType]


def _make_observation(obs: dict[str, Any]) -> torch.Tensor:
    agent = obs["agent"]
    state = [
        value for name, value in obs["extra"].items() if name != "tcp_pose"
    ]  # as in `concatenate_privileged_state`
    return join_observation(agent["qpos"], agent["tcp_in_arm_base"], agent[GRIPPER_WIDTH], torch.cat(state, dim=1))


class PpoEnvironments:
    """Training environments of `ppo`.

    ``envs`` is the vector environment of the training; `make_envs` makes others, such as those of the test.

    All episodes have the same length: a success does not end an episode. Each env keeps its objects; only the layout
    changes at a reset.
    """

    def __init__(self, config: PpoConfig, device: str) -> None:
        scenes = load_scenes(config)
        kwargs: dict[str, Any] = robocas_ms3.rl_kwargs(config.task, scenes) | {"obs_mode": "state_dict"}
        if kwargs["control_mode"] != "pd_ee_delta_pose":
            what = "the base moves in this task configuration, and ppo controls only the arm"
            raise TrainingError(
                what, where=config.scenes or config.task, fix="Choose a task configuration without base_motion."
            )
        horizon = config.horizon or (ONE_FRUIT_STEPS if config.scenes is None else kwargs["max_episode_steps"])
        self._config, self._device = config, device
        self._kwargs: dict[str, Any] = kwargs | {"max_episode_steps": horizon}
        self.name = f"episodes of {config.scenes or f'one fruit, {config.task}'}"
        settings = scenes.model_dump(mode="json", exclude={"description"})
        scene = {"task": config.task, "scenes": settings, "horizon": horizon}
        self.hash = hashlib.sha256(json.dumps(scene, sort_keys=True).encode()).hexdigest()
        self.episodes = config.layouts
        name = Path(config.scenes).stem if config.scenes else "one fruit"
        self.scenes = TrainingScenes(tasks=[config.task], configs={name: select_scene_settings(scenes)})
        self.envs = self.make_envs(config.envs, 0, config.layouts - 1)
        shape = self.envs.single_observation_space.shape
        assert shape is not None
        self.facts: dict[str, Any] = {
            "observation_size": shape[0],
            "action_size": ACTION_SIZE,
            "rate_hz": CONTROL_FREQ,
            **scene,
        }

    def __len__(self) -> int:
        return self._config.train.steps

    def make_envs(self, count: int, first_seed: int, last_seed: int) -> VectorEnv:
        """Make ``count`` environments that use the layouts of the seeds from ``first_seed`` to ``last_seed``."""
        return robocas_ms3.make_vec(
            next(spec.env_id for spec in TASKS.values() if self._config.task in (spec.name, spec.env_id)),
            count,
            backend="gpu" if self._device == "cuda" else "processes",
            workers=self._config.workers if self._device == "cpu" else None,
            wrappers=[TopDownActionWrapper],
            ignore_terminations=True,
            reconfiguration_freq=0,
            seeds=(first_seed, last_seed),
            **self._kwargs,
        )

    def close(self) -> None:
        self.envs.close()


def load_scenes(config: PpoConfig) -> TaskConfig:
    """Load the task configuration ``config.scenes``; without one, make that of a single fruit on a table."""
    if config.scenes is not None:
        return load_task_config(config.scenes)
    return load_task_config(load_task_config("pick_table_scattered").model_dump(mode="json") | ONE_FRUIT)
