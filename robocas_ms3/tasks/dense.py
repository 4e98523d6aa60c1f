"""Dense rewards of an environment: the terms of `rewards`, weighed by a task's table, and what they remember."""

from __future__ import annotations

from typing import Any

import torch

from robocas_ms3.core.arrays import as_tensor, choose, native
from robocas_ms3.tasks import rewards

DENSE = ("normalized_dense", "dense", "progress")  # reward modes whose terms are computed


class DenseReward:
    """Weighs terms and penalties, and remembers the last action and reward.

    Args:
        env: the `base.RoboCASEnv`.
        table: weights of its terms.

    Attributes:
        last_action: (N, A), NaN where there was none since the reset; None: none yet.
        last_level: (N,) last normalized reward of the mode ``progress``, NaN where there was none since the reset.
    """

    def __init__(self, env: Any, table: rewards.RewardTable) -> None:
        self._env, self._table = env, table
        self.last_action: torch.Tensor | None = None
        self.last_level: torch.Tensor | None = None

    def reset(self, envs: Any) -> None:
        """Forget the last action and reward of some envs."""
        for last in (self.last_action, self.last_level):
            if last is not None:
                last[envs] = torch.nan

    def remember(self, action: Any) -> None:
        """Remember the action of this step."""
        self.last_action = torch.as_tensor(action, device=self._env.device).reshape(self._env.num_envs, -1).clone()

    def gain(self, level: torch.Tensor) -> torch.Tensor:
        """Return how much a reward (N,) has risen since the last step; 0 in the first one."""
        before = level if self.last_level is None else self.last_level
        self.last_level = level.clone()
        return (level - before).nan_to_num()

    def of_goal(self) -> tuple[Any, dict[str, Any]]:
        """Return stages (N,) and terms by name, (N,) in [0, 1] each, of the goal; native (`arrays`)."""
        brought = native(self._env.success_check.stages["target_lifted"])
        return self._env.goal.progress(self._env.moment, brought, self._table)

    def weigh(self, stage: Any, found: dict[str, Any], action: Any, info: dict[str, Any]) -> torch.Tensor:
        """Return the reward (N,) in [0, total of the table], and add ``reward_terms`` to the info.

        Args:
            stage: (N,) places in the table's stages, native (`arrays`).
            found: terms by name, (N,) in [0, 1] each, native.
            action: of this step.
            info: of this step, from `RoboCASEnv.evaluate`.
        """
        penalties = self._penalties(action)
        stage = choose(native(info["success"]), 0 * stage + len(self._table.stages), stage)
        reward, counted = rewards.weigh(self._table, stage, found, penalties)
        counted.update(penalties)
        info["reward_terms"] = {name: as_tensor(term) for name, term in counted.items()}
        return as_tensor(reward * ~native(info["fail"]))

    def _penalties(self, action: Any) -> dict[str, Any]:
        """The table's penalties by name, (N,) in [0, 1] each, native."""
        moment = self._env.moment
        found = {
            "disturbed": rewards.count_share(moment.disturbed.sum(1)),
            **self._env.goal.penalties(moment),
            "action_rate": self._action_rate(action),
        }
        return {name: found[name] for name in self._table.penalties}

    def _action_rate(self, action: Any) -> Any:
        before = self.last_action
        if action is None or before is None or before.shape[-1] != action.shape[-1]:
            return native(torch.zeros(self._env.num_envs, device=self._env.device))
        action = torch.as_tensor(action, device=self._env.device).reshape(self._env.num_envs, -1)
        return rewards.action_rate(native(action), native(torch.where(before.isnan(), action, before)))
