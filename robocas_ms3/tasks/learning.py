"""What there is to learn from: dense rewards, and what only a simulator can tell a policy. See docs/rl.md."""

from __future__ import annotations

from typing import Any, ClassVar

import torch

from robocas_ms3.core.arrays import as_tensor, choose, join, native
from robocas_ms3.tasks import rewards, terms
from robocas_ms3.tasks.goals import DenseGoal
from robocas_ms3.tasks.transfer import TransferEnv

DENSE = ("normalized_dense", "dense", "progress")  # reward modes whose terms are worked out


class LearningEnv(TransferEnv):
    """Moves the target to its goal, a `DenseGoal`, and says how far that has come.

    The reward of ``normalized_dense`` lies in [0, 1]: 1 on success and then only, 0 on ``fail``, else what `rewards`
    makes of the table ``REWARDS``. ``dense`` is the same times the table's total. ``progress`` is how much the first
    has changed since the last step, so that an episode sums up to where it has come; a first step pays nothing. In all
    three ``info`` holds ``reward_terms``: by name (N,) in [0, 1], first the terms as they count, then the penalties.
    In other modes nothing of this is worked out.
    """

    SUPPORTED_REWARD_MODES = ("sparse", *DENSE, "none")  # the first is the default
    REWARDS: ClassVar[rewards.RewardTable] = rewards.TRANSFER
    # NaN where there was none since the reset
    _last_action: torch.Tensor | None = None  # (N, A)
    _last_level: torch.Tensor | None = None  # (N,)

    def _load_scene(self, options: dict) -> None:
        super()._load_scene(options)
        assert isinstance(self.goal, DenseGoal), "the task's goal does not say how near it is"
        self._nearness = self.goal

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        super()._initialize_episode(env_idx, options)
        self._target_extents = terms.of_target(self._extents, self.target_slot)
        self._forget_the_last(env_idx)

    def set_state_dict(self, state: dict, env_idx: torch.Tensor | None = None) -> None:
        """Set the state; see `TransferEnv`. The next step's reward is as that after a reset."""
        super().set_state_dict(state, env_idx)
        self._forget_the_last(slice(None) if env_idx is None else env_idx)

    def _forget_the_last(self, envs: Any) -> None:
        for last in (self._last_action, self._last_level):
            if last is not None:
                last[envs] = torch.nan

    # ------------------------------------------------------------------ rewards

    def get_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        """(N,) the reward of the env's mode; remembers the action."""
        if self._reward_mode != "progress":
            reward = super().get_reward(obs, action, info)
        else:
            level = self.compute_normalized_dense_reward(obs, action, info)
            before = level if self._last_level is None else self._last_level
            reward, self._last_level = (level - before).nan_to_num(), level.clone()
        if self._reward_mode in DENSE and action is not None:
            self._last_action = torch.as_tensor(action, device=self.device).reshape(self.num_envs, -1).clone()
        return reward

    def compute_dense_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        """(N,) float32 in [0, ``REWARDS.total``]; adds ``reward_terms`` to ``info``, which is the last step's."""
        assert self._moment is not None, "info came of `evaluate`"
        stage, found = self._progress()
        penalties = self._penalties(action)
        stage = choose(native(info["success"]), 0 * stage + len(self.REWARDS.stages), stage)
        reward, counted = rewards.weigh(self.REWARDS, stage, found, penalties)
        counted.update(penalties)
        info["reward_terms"] = {name: as_tensor(term) for name, term in counted.items()}
        return as_tensor(reward * ~native(info["fail"]))

    def compute_normalized_dense_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        """(N,) float32 in [0, 1]; see `compute_dense_reward`."""
        return self.compute_dense_reward(obs, action, info) / self.REWARDS.total

    def _progress(self) -> tuple[Any, dict[str, Any]]:
        """Stages (N,) and the terms that count in them by name, (N,) each; all native (`arrays`), of `evaluate`."""
        now = self._moment
        assert now is not None
        return self._nearness.progress(now, native(self._stages["target_lifted"]), self.REWARDS)

    def _penalties(self, action: Any) -> dict[str, Any]:
        """The table's penalties by name, (N,) in [0, 1] each, native (`arrays`)."""
        now = self._moment
        assert now is not None
        found = {
            "disturbed": rewards.count_share(now.disturbed.sum(1)),
            **self._nearness.penalties(now),
            "action_rate": self._action_rate(action),
        }
        return {name: found[name] for name in self.REWARDS.penalties}

    def _action_rate(self, action: Any) -> Any:
        before = self._last_action
        if action is None or before is None or before.shape[-1] != action.shape[-1]:
            return native(torch.zeros(self.num_envs, device=self.device))
        action = torch.as_tensor(action, device=self.device).reshape(self.num_envs, -1)
        return rewards.action_rate(native(action), native(torch.where(before.isnan(), action, before)))

    # ------------------------------------------------------------------ observations

    def _privileged(self) -> dict[str, torch.Tensor]:
        state, tcp = self.bodies.read(), self.tcp_in_world()
        center = self.target_center(native(self._objects_in(state)))
        point = self._nearness.point(self._native_basket(state))
        seen = seen_from(tcp, join([center - tcp[:, :3], point - center]).reshape(-1, 2, 3))
        return {
            **super()._privileged(),
            "tcp_to_target": seen[:, 0],
            self._nearness.TOWARDS: seen[:, 1],
            "target_extents": self._target_extents,
        }


def seen_from(tcp: Any, vectors: Any) -> torch.Tensor:
    """(N, V, 3) vectors of the world along the axes of poses (N, 7), from native ones (`arrays`)."""
    return as_tensor(vectors @ terms.rotation(tcp[:, 3:]))
