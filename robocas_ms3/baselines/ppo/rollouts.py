"""Rollouts with advantages, and the outcomes of episodes."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import torch
from gymnasium.vector import VectorEnv

from robocas_ms3.baselines.ppo.agent import Agent
from robocas_ms3.baselines.ppo.config import PpoConfig

OUTCOMES = ("return", "held", "lifted", "success")  # of an episode; all but the return at its end
_LAST_EPISODES = 100  # that are averaged in the log


@dataclass(frozen=True)
class Rollout:
    """Steps of all environments, B in all.

    Attributes:
        obs: (B, O) observations.
        normalized: (B, O) observations as the policy got them.
        action: (B, A).
        log_prob: (B,) of the actions.
        advantage: (B,).
        returns: (B,) targets of the value.
    """

    obs: torch.Tensor
    normalized: torch.Tensor
    action: torch.Tensor
    log_prob: torch.Tensor
    advantage: torch.Tensor
    returns: torch.Tensor


class RolloutCollector:
    """Steps environments with a policy and its noise, and keeps the outcomes of the last episodes."""

    def __init__(self, envs: VectorEnv, agent: Agent, config: PpoConfig, episodes: int, outcomes: torch.Tensor) -> None:
        self.episodes = episodes
        self._envs, self._agent, self._config = envs, agent, config
        self._outcomes: deque[list[float]] = deque(outcomes.tolist(), maxlen=_LAST_EPISODES)
        first = config.train.seed * config.envs + episodes
        self._obs: torch.Tensor = envs.reset(seed=first % config.layouts)[0]

    def last_outcomes(self) -> torch.Tensor:
        """Return the (n, 4) `OUTCOMES` of the last episodes."""
        return torch.tensor(list(self._outcomes)).reshape(-1, len(OUTCOMES))

    @torch.no_grad()
    def collect(self) -> Rollout:
        """Take the steps of one update."""
        agent, config = self._agent, self._config
        steps = []
        for _ in range(steps_per_env(config)):
            obs = self._obs
            normalized = agent.normalize(obs)
            policy = agent.policy(normalized)
            action = policy.sample()
            self._obs, reward, _, truncated, info = self._envs.step(action)  # pyright: ignore[reportArgumentType]
            # Episodes end by truncation alone, so the value of the observation after it counts
            next_value = agent.value(agent.normalize(info.get("final_obs", self._obs)))
            log_prob = policy.log_prob(action).sum(-1)
            value = agent.value(normalized)
            steps.append((obs, normalized, action, log_prob, reward, value, next_value, truncated))
            if "final_info" in info:
                ended = read_outcomes(info)
                self._outcomes.extend(ended.tolist())
                self.episodes += len(ended)
        obs, normalized, action, log_prob, reward, value, next_value, truncated = (
            torch.stack(part) for part in zip(*steps, strict=True)
        )
        deltas = reward + config.gamma * next_value - value
        advantage = advantages(deltas, truncated, config.gamma * config.trace)
        parts = (obs, normalized, action, log_prob, advantage, advantage + value)
        return Rollout(*(part.flatten(0, 1) for part in parts))


def steps_per_env(config: PpoConfig) -> int:
    """Return the number of steps of each environment between updates."""
    return max(config.train.batch_size // config.envs, 1)


def advantages(deltas: torch.Tensor, truncated: torch.Tensor, decay: float) -> torch.Tensor:
    """Return generalised advantages (T, N) (Schulman et al. 2016).

    Args:
        deltas: (T, N) temporal differences.
        truncated: (T, N) whether the episode ended after the step.
        decay: discount times lambda.
    """
    found, last = torch.zeros_like(deltas), torch.zeros_like(deltas[0])
    for t in reversed(range(len(deltas))):
        last = found[t] = deltas[t] + decay * ~truncated[t] * last
    return found


def read_outcomes(info: dict[str, Any]) -> torch.Tensor:
    """Return the (n, 4) `OUTCOMES` of the episodes that have just ended."""
    final = info["final_info"]
    held = final["reward_terms"]["grasp"] == 1
    parts = [final["episode"]["return"], held, final["target_lifted"], final["success"]]
    return torch.stack([part.float() for part in parts], dim=1)[info["_final_info"]]
