"""Policy and value networks, on observations normalised by their running statistics."""

from __future__ import annotations

import torch
from torch import nn
from torch.distributions import Normal


class Agent(nn.Module):
    """Two networks of two layers, and the statistics of the observations.

    Args:
        observed: size of an observation.
        acted: size of an action.
        width: of the layers.
    """

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


def _layers(inputs: int, width: int, outputs: int, gain: float) -> nn.Sequential:
    last = nn.Linear(width, outputs)
    layers = nn.Sequential(nn.Linear(inputs, width), nn.Tanh(), nn.Linear(width, width), nn.Tanh(), last)
    for layer in layers:
        if isinstance(layer, nn.Linear):
            nn.init.orthogonal_(layer.weight, gain if layer is last else 2**0.5)
            nn.init.zeros_(layer.bias)
    return layers
