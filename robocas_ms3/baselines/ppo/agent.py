"""Networks of `ppo` (policy and value function), and the policy for evaluations."""

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
    """Policy network and value network of PPO, with running statistics that normalise their observations.

    Args:
        observation_size: number of values of an observation, O.
        action_size: number of values of an action, A.
        width: size of the two hidden layers.
    """

    mean: torch.Tensor
    square: torch.Tensor
    count: torch.Tensor

    def __init__(self, observation_size: int, action_size: int, width: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(observation_size))
        self.register_buffer("square", torch.ones(observation_size))
        self.register_buffer("count", torch.tensor(1e-4, dtype=torch.float64))
        self.actor = _make_layers(observation_size, width, action_size, 0.01)
        self.critic = _make_layers(observation_size, width, 1, 1.0)
        self.log_std = nn.Parameter(torch.full((action_size,), -0.7))

    @torch.no_grad()
    def update_statistics(self, obs: torch.Tensor) -> None:
        """Update the running mean and mean square with observations (N, O)."""
        self.count += len(obs)
        fraction = (len(obs) / self.count).float()
        self.mean += fraction * (obs.mean(dim=0) - self.mean)
        self.square += fraction * ((obs**2).mean(dim=0) - self.square)

    def normalize(self, obs: torch.Tensor) -> torch.Tensor:
        """Return normalised observations (N, O): mean 0, standard deviation 1, clipped to [-5, 5]."""
        deviation = (self.square - self.mean**2).clamp(min=1e-6).sqrt()
        return ((obs - self.mean) / deviation).clamp(-5, 5)

    def action_distribution(self, normalized: torch.Tensor) -> Normal:
        """Return the distribution of the actions (N, A), for normalised observations (N, O)."""
        return Normal(self.actor(normalized), self.log_std.exp())

    def estimate_value(self, normalized: torch.Tensor) -> torch.Tensor:
        """Return the estimated discounted returns (N,), for normalised observations (N, O)."""
        return self.critic(normalized)[:, 0]

    def mean_action(self, obs: torch.Tensor) -> torch.Tensor:
        """Return the mean actions (N, A), for observations (N, O) that are not normalised."""
        return self.actor(self.normalize(obs))


def make_agent(config: PpoConfig, facts: dict[str, Any]) -> Agent:
    """Make an agent with random weights, for the observation and action sizes in ``facts``."""
    return Agent(facts["observation_size"], facts["action_size"], config.width)


def _make_layers(inputs: int, width: int, outputs: int, gain: float) -> nn.Sequential:
    last = nn.Linear(width, outputs)
    layers = nn.Sequential(nn.Linear(inputs, width), nn.Tanh(), nn.Linear(width, width), nn.Tanh(), last)
    for layer in layers:
        if isinstance(layer, nn.Linear):
            nn.init.orthogonal_(layer.weight, gain if layer is last else 2**0.5)
            nn.init.zeros_(layer.bias)
    return layers


class PpoPolicy:
    """Policy of `ppo`, which executes the mean action of the agent.

    An action commands the same motion as in the training.
    """

    def __init__(self, config: PpoConfig, facts: dict[str, Any], agent: Agent) -> None:
        # Rotations are about one axis: Euler angles and rotation vectors are equal
        self.spec = PolicySpec(
            "delta_axis_angle", reference="target", rate_hz=facts["rate_hz"], state=True, language="none"
        )
        self._agent, self._size = agent, facts["observation_size"]

    def reset(self, episodes: list[EpisodeSpec]) -> None:
        pass

    def act(self, observations: Observations) -> NDArray[np.floating]:
        """Return one action per env (E, 7): translation in m, axis-angle rotation in rad, gripper (1 = open)."""
        assert observations.state is not None
        width = observations.robot[GRIPPER_WIDTH]
        obs = join_observation(observations.qpos, observations.tcp_in_base, width, observations.state)
        if obs.shape[1] != self._size:
            what, fix = "wrong size of the observation", "Evaluate in the task configuration of the training."
            raise EvaluationError(what, where="ppo", expected=f"{self._size} numbers", found=obs.shape[1], fix=fix)
        with torch.inference_mode():
            action = expand_action(self._agent.mean_action(obs.to(self._agent.mean.device)))
        return action.double().cpu().numpy() * _SCALE
