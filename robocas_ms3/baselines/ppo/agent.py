"""The agent of `ppo`: policy and value networks, and how it acts in an evaluation."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn
from torch.distributions import Normal

from robocas_ms3.baselines.ppo.config import PpoConfig
from robocas_ms3.baselines.ppo.environments import expand_action, join_observation
from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.evaluation.policy import EpisodeSpec, Observations, PolicySpec
from robocas_ms3.robots.ee_deltas import POSITION_SCALE, ROTATION_SCALE
from robocas_ms3.robots.quantities import GRIPPER_WIDTH

_SCALE = np.array([POSITION_SCALE] * 3 + [ROTATION_SCALE] * 3 + [1.0])


class Agent(nn.Module):
    """Two networks of two layers, on observations normalised by their running statistics."""

    mean: torch.Tensor
    square: torch.Tensor
    count: torch.Tensor

    def __init__(self, observed: int, acted: int, width: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(observed))
        self.register_buffer("square", torch.ones(observed))
        self.register_buffer("count", torch.tensor(1e-4, dtype=torch.float64))
        self.actor, self.critic = _layers(observed, width, acted, 0.01), _layers(observed, width, 1, 1.0)
        self.log_std = nn.Parameter(torch.full((acted,), -0.7))

    @torch.no_grad()
    def update_statistics(self, obs: torch.Tensor) -> None:
        """Add observations (N, O) to the running mean and mean square."""
        self.count += len(obs)
        share = (len(obs) / self.count).float()
        self.mean += share * (obs.mean(dim=0) - self.mean)
        self.square += share * ((obs**2).mean(dim=0) - self.square)

    def normalize(self, obs: torch.Tensor) -> torch.Tensor:
        """Return observations (N, O) with mean 0 and deviation 1, clipped to [-5, 5]."""
        deviation = (self.square - self.mean**2).clamp(min=1e-6).sqrt()
        return ((obs - self.mean) / deviation).clamp(-5, 5)

    def policy(self, normalized: torch.Tensor) -> Normal:
        """Return the distribution of actions (N, A) for normalised observations."""
        return Normal(self.actor(normalized), self.log_std.exp())

    def value(self, normalized: torch.Tensor) -> torch.Tensor:
        """Return values (N,) of normalised observations."""
        return self.critic(normalized)[:, 0]

    def best(self, obs: torch.Tensor) -> torch.Tensor:
        """Return actions (N, A) without noise for observations that are not normalised."""
        return self.actor(self.normalize(obs))


def make_agent(config: PpoConfig, facts: dict[str, Any]) -> Agent:
    return Agent(facts["observed"], facts["acted"], config.width)


def _layers(inputs: int, width: int, outputs: int, gain: float) -> nn.Sequential:
    last = nn.Linear(width, outputs)
    layers = nn.Sequential(nn.Linear(inputs, width), nn.Tanh(), nn.Linear(width, width), nn.Tanh(), last)
    for layer in layers:
        if isinstance(layer, nn.Linear):
            nn.init.orthogonal_(layer.weight, gain if layer is last else 2**0.5)
            nn.init.zeros_(layer.bias)
    return layers


class PpoPolicy:
    """Acts without noise, in the convention of ``pd_ee_delta_pose``."""

    def __init__(self, config: PpoConfig, facts: dict[str, Any], agent: Agent) -> None:
        # Rotations are about one axis, where Euler angles and rotation vectors are the same
        self.spec = PolicySpec(
            "delta_axis_angle", reference="target", rate_hz=facts["rate_hz"], state=True, language="none"
        )
        self._agent, self._size = agent, facts["observed"]

    def reset(self, episodes: list[EpisodeSpec]) -> None:
        pass

    def act(self, observations: Observations) -> NDArray[np.floating]:
        """Return actions (E, 7)."""
        assert observations.state is not None
        width = observations.robot[GRIPPER_WIDTH]
        obs = join_observation(observations.qpos, observations.tcp_in_base, width, observations.state)
        if obs.shape[1] != self._size:
            what, fix = "the policy was trained in other scenes", "Evaluate it in the task and scenes of its training."
            raise EvaluationError(what, where="ppo", expected=f"{self._size} numbers", found=obs.shape[1], fix=fix)
        with torch.inference_mode():
            action = expand_action(self._agent.best(obs.to(self._agent.mean.device)))
        return action.double().cpu().numpy() * _SCALE
