"""What comes of trying: steps with their advantages, and how episodes ended."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import torch
from gymnasium.vector import VectorEnv

from robocas_ms3.baselines.ppo.agent import Agent
from robocas_ms3.baselines.ppo.config import PpoConfig

OUTCOMES = ("return", "held", "lifted", "success")  # of an episode; but for the first, at its end
_EPISODES = 100  # the last, that are told of


@dataclass(frozen=True)
class Tried:
    """Steps of all environments, B in all.

    Attributes:
        obs: (B, O) as they are.
        seen: (B, O) as the policy saw them.
        action: (B, A).
        log_prob: (B,) of the actions.
        advantage: (B,).
        returns: (B,) what the value should have been.
    """

    obs: torch.Tensor
    seen: torch.Tensor
    action: torch.Tensor
    log_prob: torch.Tensor
    advantage: torch.Tensor
    returns: torch.Tensor


class Rollouts:
    """Steps environments with a policy and its noise, and keeps what came of the last episodes.

    Args:
        envs: to try in; each begins with another layout, and goes on with the next ones.
        agent: that acts.
        config: see `PpoConfig`.
        played: episodes that were played before; what came of the last of them, (n, 4) `OUTCOMES`.
    """

    def __init__(self, envs: VectorEnv, agent: Agent, config: PpoConfig, played: tuple[int, torch.Tensor]) -> None:
        self._envs, self._agent, self._config = envs, agent, config
        self.played, last = played
        self.episodes: deque[list[float]] = deque(last.tolist(), maxlen=_EPISODES)
        first = config.train.seed * config.envs + self.played
        self._obs: torch.Tensor = envs.reset(seed=first % config.layouts)[0]

    @torch.no_grad()
    def collect(self) -> Tried:
        """Take `batch_size` steps, or as many less as environments don't share."""
        agent, config = self._agent, self._config
        steps = []
        for _ in range(steps_of(config)):
            obs = self._obs
            seen = agent.normal(obs)
            policy = agent.policy(seen)
            action = policy.sample()
            self._obs, reward, _, over, info = self._envs.step(action)  # pyright: ignore[reportArgumentType]
            # time was up, and nothing else: what would have come next still counts
            following = agent.value(agent.normal(info.get("final_observation", self._obs)))
            log_prob = policy.log_prob(action).sum(-1)
            steps.append((obs, seen, action, log_prob, reward, agent.value(seen), following, over))
            if "final_info" in info:
                ended = outcomes(info)
                self.episodes.extend(ended.tolist())
                self.played += len(ended)
        obs, seen, action, log_prob, reward, value, following, over = (
            torch.stack(part) for part in zip(*steps, strict=True)
        )
        advantage = advantages(reward, value, following, over, config.gamma, config.trace)
        parts = (obs, seen, action, log_prob, advantage, advantage + value)
        return Tried(*(part.flatten(0, 1) for part in parts))


def steps_of(config: PpoConfig) -> int:
    """Steps of each environment between updates."""
    return max(config.train.batch_size // config.envs, 1)


def advantages(
    reward: torch.Tensor,
    value: torch.Tensor,
    following: torch.Tensor,
    over: torch.Tensor,
    gamma: float,
    trace: float,
) -> torch.Tensor:
    """(T, N) generalised advantages (Schulman et al. 2016).

    Args:
        reward: (T, N) of steps.
        value: (T, N) of what was seen before them.
        following: (T, N) of what was seen after them, in the same episode.
        over: (T, N) whether the episode's time was up after them.
        gamma: discount.
        trace: lambda.
    """
    delta = reward + gamma * following - value
    found, last = torch.zeros_like(delta), torch.zeros_like(delta[0])
    for t in reversed(range(len(delta))):
        last = found[t] = delta[t] + gamma * trace * ~over[t] * last
    return found


def outcomes(info: dict[str, Any]) -> torch.Tensor:
    """(n, 4) `OUTCOMES` of the episodes that have just ended."""
    final = info["final_info"]
    held = final["reward_terms"]["grasp"] == 1
    parts = [final["episode"]["return"], held, final["target_lifted"], final["success"]]
    return torch.stack([part.float() for part in parts], dim=1)[info["_final_info"]]
