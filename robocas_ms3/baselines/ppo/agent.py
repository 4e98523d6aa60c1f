"""Policy and value of what is observed, normalised by what was observed before."""

from __future__ import annotations

import torch
from torch import nn
from torch.distributions import Normal


class Agent(nn.Module):
    """Two networks of two layers, and what observations are like.

    Args:
        observed: numbers of an observation.
        acted: numbers of an action.
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
    def see(self, obs: torch.Tensor) -> None:
        """Learn what observations (N, O) are like."""
        self.count += len(obs)
        share = (len(obs) / self.count).float()
        self.mean += share * (obs.mean(dim=0) - self.mean)
        self.square += share * ((obs**2).mean(dim=0) - self.square)

    def normal(self, obs: torch.Tensor) -> torch.Tensor:
        """(N, O) observations in deviations from their mean, 5 at most."""
        deviation = (self.square - self.mean**2).clamp(min=1e-6).sqrt()
        return ((obs - self.mean) / deviation).clamp(-5, 5)

    def policy(self, seen: torch.Tensor) -> Normal:
        """Of actions (N, A), for normalised observations."""
        return Normal(self.actor(seen), self.log_std.exp())

    def value(self, seen: torch.Tensor) -> torch.Tensor:
        """(N,) of normalised observations."""
        return self.critic(seen)[:, 0]

    def best(self, obs: torch.Tensor) -> torch.Tensor:
        """(N, A) actions without noise, for observations as they are."""
        return self.actor(self.normal(obs))


def _layers(inputs: int, width: int, outputs: int, gain: float) -> nn.Sequential:
    last = nn.Linear(width, outputs)
    layers = nn.Sequential(nn.Linear(inputs, width), nn.Tanh(), nn.Linear(width, width), nn.Tanh(), last)
    for layer in layers:
        if isinstance(layer, nn.Linear):
            nn.init.orthogonal_(layer.weight, gain if layer is last else 2**0.5)
            nn.init.zeros_(layer.bias)
    return layers
