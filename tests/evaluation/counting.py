"""An environment of nothing but numbers, for the loop that plays episodes."""

from __future__ import annotations

from typing import Any

import numpy as np

from robocas_ms3.core.errors import WorkerDied
from robocas_ms3.evaluation.metrics import SUMS
from robocas_ms3.evaluation.policy import EpisodeSpec, Policy
from robocas_ms3.evaluation.rollout import EndConditions, EpisodeBatch, Rollout, rollout


def play(
    env: Any, policy: Policy, episodes: list[EpisodeSpec], max_steps: int, *, refill: bool = True
) -> list[Rollout]:
    """Run episodes with a policy, 0.05 s per step."""
    batch = EpisodeBatch(env, policy.spec, EndConditions(max_steps), 0.05, refill=refill)
    return list(rollout(batch, policy, episodes))


class Counting:
    """N envs of which each succeeds once the sum of its first action numbers has come to its seed."""

    def __init__(self, num_envs: int) -> None:
        self.num_envs, self.resets = num_envs, []
        self.seeds, self.sums = np.zeros(num_envs, int), np.zeros(num_envs)
        self.elapsed = np.zeros(num_envs, np.int32)

    def reset(self, *, seed: list[int], options: dict[str, Any]) -> tuple[Any, dict]:
        envs = options.get("env_idx", np.arange(self.num_envs))
        self.resets.append(list(envs))
        self.seeds[envs], self.sums[envs], self.elapsed[envs] = seed, 0, 0
        return self._seen(), self._info()

    def step(self, actions: np.ndarray) -> tuple:
        self.sums += actions[:, 0]
        self.elapsed += 1
        return self._seen(), None, None, None, self._info()

    def _seen(self) -> dict[str, Any]:
        column = self.sums[:, None].astype(np.float32)
        agent = {"qpos": np.tile(column, 12), "tcp_in_arm_base": np.tile(column, 7), "gripper_width": column}
        return {"agent": agent, "extra": {"seed": self.seeds[:, None].astype(np.float32), "tcp_pose": column}}

    def _info(self) -> dict[str, Any]:
        tracked = {"sums": np.zeros((self.num_envs, len(SUMS)), np.float32)}
        done = self.sums >= self.seeds
        return {**tracked, "success": done, "fail": ~done & False, "elapsed_steps": self.elapsed.copy()}


class Dying(Counting):
    """Envs in a process that dies in the second step of a seed, so often; ``deaths`` counts down."""

    def __init__(self, num_envs: int, seed: int, deaths: list[int]) -> None:
        super().__init__(num_envs)
        self.deadly, self.deaths, self.closed = seed, deaths, False

    def step(self, actions: np.ndarray) -> tuple:
        at = [env for env in range(self.num_envs) if self.seeds[env] == self.deadly and self.elapsed[env] == 1]
        if at and self.deaths[0] > 0:
            self.deaths[0] -= 1
            died = WorkerDied("its process died", found="SIGSEGV")
            died.envs = tuple(at)
            raise died
        return super().step(actions)

    def close(self) -> None:
        self.closed = True
