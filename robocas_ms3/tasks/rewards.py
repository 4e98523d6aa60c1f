"""Dense rewards: named terms in [0, 1], weighted by the reward table of a task.

N envs; arrays are native (`core.arrays`).

A task is a sequence of reward stages, and each env is in one stage at a time. Terms of earlier stages count in full,
terms of the current stage count with their values, and terms of later stages don't count. So a later stage always has
at least the reward of an earlier stage.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch

from robocas_ms3.core.arrays import Array, as_float32, as_tensor, clamp, norm, to_native, where
from robocas_ms3.scenes.task_specs import MAX_HIDDEN_FRACTION, MAX_OBSTACLES
from robocas_ms3.tasks.terms import BASKET_SHIFT

_MANY_OBSTACLES = 5  # obstacles beyond those that a cleared target may have; more of them change no reward
DENSE_MODES = ("normalized_dense", "dense", "progress")  # reward modes that need the terms


@dataclass(frozen=True)
class RewardTable:
    """Stages, weights and penalties of a task's dense reward.

    Attributes:
        stages: stage name -> term name -> weight, in the order of the stages.
        penalties: penalty name -> greatest fraction of the current stage's terms that it subtracts; the sum is below 1.
    """

    stages: dict[str, dict[str, float]]
    penalties: dict[str, float]

    @cached_property
    def weights(self) -> dict[str, float]:
        """Weight of each term by name."""
        return {name: weight for terms in self.stages.values() for name, weight in terms.items()}

    @cached_property
    def total(self) -> float:
        """Sum of the weights: the reward of success."""
        return sum(self.weights.values())

    def stage_index(self, stage: str) -> int:
        """Return the place of a stage in the order of the stages, from 0."""
        return list(self.stages).index(stage)


_TRANSFER = {
    "grasp": {"reach": 2.0, "grasp": 2.0},
    "lift": {"lift": 1.0},
    "carry": {"carry": 2.0},
    "place": {"place": 1.0},
    "release": {"released": 0.5},
    "rest": {"at_rest": 0.5, "success": 1.0},
}
# pick and select
TRANSFER = RewardTable(_TRANSFER, {"disturbed": 0.1, "basket_shift": 0.1, "action_rate": 0.05})
# without the penalty `disturbed`, because clearing disturbs objects on purpose
SEARCH = RewardTable(
    {"clear": {"push_point": 1.0, "clear": 3.0}, **_TRANSFER}, {"basket_shift": 0.1, "action_rate": 0.05}
)
OPEN_PICK = RewardTable({"open": {"handle": 1.0, "open": 3.0}, **_TRANSFER}, TRANSFER.penalties)


def weighted_reward(
    table: RewardTable, stage: Array, terms: dict[str, Array], penalties: dict[str, Array]
) -> tuple[Array, dict[str, Array]]:
    """Return the weighted reward of each env from its reward stage, terms and penalties.

    Args:
        table: reward table of the task.
        stage: (N,) indices into ``table.stages``; ``len(table.stages)`` in envs that have succeeded.
        terms: values (N,) in [0, 1] of the terms by name; a missing term counts as 0 in the current stage.
        penalties: values (N,) in [0, 1] of the penalties by name.

    Returns:
        Rewards (N,) in [0, ``table.total``], and the values (N,) in [0, 1] by term name that the rewards count.
    """
    none = 0.0 * as_float32(stage)
    kept = 1.0 - sum((fraction * penalties[name] for name, fraction in table.penalties.items()), none)
    counted, reward = {}, none
    for place, own in enumerate(table.stages.values()):
        passed, here = as_float32(stage > place), as_float32(stage == place) * kept
        for name, weight in own.items():
            counted[name] = passed + here * terms.get(name, none)
            reward = reward + weight * counted[name]
    return where(stage >= len(table.stages), none + table.total, reward), counted


def furthest_stage(default: Array, conditions: list[tuple[Array, int]]) -> Array:
    """Return the furthest stage (N,) whose condition is true.

    Args:
        default: (N,) stage if no condition is true.
        conditions: pairs of a condition (N,) bool and its stage; a later pair takes precedence.
    """
    stage = default
    for condition, place in conditions:
        stage = where(condition, 0 * stage + place, stage)
    return stage


def nearness(points: Array, goals: Array, *, half_distance: float = 0.1) -> Array:
    """Return the nearness (N,) of points (N, 3) to goals: 1 at the goal, 0.5 at ``half_distance`` m."""
    return half_distance / (half_distance + norm(goals - points))


def change_fraction(value: Array, start: Array | float, full_change: float) -> Array:
    """Return (``value`` - ``start``) / ``full_change``, clipped to [0, 1], for values (N,)."""
    return clamp((value - start) / full_change, 0.0, 1.0)


def clear_fraction(hidden_fraction: Array, obstacle_count: Array) -> Array:
    """Return (N,) in [0, 1]: 1 for a cleared target, less if more is hidden or obstacles are left.

    Args:
        hidden_fraction: (N,) hidden fraction of the target.
        obstacle_count: (N,) number of obstacles.
    """
    hidden = clamp((hidden_fraction - MAX_HIDDEN_FRACTION) / (1 - MAX_HIDDEN_FRACTION), 0.0, 1.0)
    around = clamp((as_float32(obstacle_count) - MAX_OBSTACLES) / _MANY_OBSTACLES, 0.0, 1.0)
    return 1 - (hidden + around) / 2


def release_fraction(held: Array, touched: Array) -> Array:
    """Return (N,): 0 if the gripper holds the target, 0.5 if it only touches it, 1 without contact."""
    return 1 - (as_float32(held) + as_float32(held | touched)) / 2


def stillness(linear_velocity: Array, angular_velocity: Array) -> Array:
    """Return (N,) in [0, 1] from velocities (N, 3) in m/s and rad/s: 1 at rest, 0 from 0.3 m/s or 5 rad/s."""
    return 1 - clamp(norm(linear_velocity) / 0.3 + norm(angular_velocity) / 5.0, 0.0, 1.0)


def disturbed_fraction(disturbed_count: Array) -> Array:
    """Return (N,) in [0, 1]: a third per disturbed object (N,), at most 1."""
    return clamp(as_float32(disturbed_count) / 3, 0.0, 1.0)


def basket_shift_fraction(position: Array, start_position: Array) -> Array:
    """Return (N,) in [0, 1]: shift of the basket (N, 3), as a fraction of the allowed 0.1 m."""
    return clamp(norm(position - start_position) / BASKET_SHIFT, 0.0, 1.0)


def action_rate(action: Array, last_action: Array) -> Array:
    """Return (N,) in [0, 1]: half the mean absolute change of the components of actions (N, A) in [-1, 1]."""
    return clamp(abs(action - last_action).mean(-1) / 2.0, 0.0, 1.0)


class DenseReward:
    """Dense reward of an environment; stores the last action and the last normalized reward.

    Args:
        table: reward table of the task.
        num_envs: N.
        device: device of the envs.

    Attributes:
        last_action: (N, A) last action of each env, NaN directly after its reset; None before the first action.
        last_normalized_reward: (N,) last normalized reward of each env in the mode ``progress``, NaN directly after its
            reset; None before the first reward.
    """

    def __init__(self, table: RewardTable, num_envs: int, device: torch.device) -> None:
        self._table, self._num_envs, self._device = table, num_envs, device
        self.last_action: torch.Tensor | None = None
        self.last_normalized_reward: torch.Tensor | None = None

    def reset(self, envs: Any) -> None:
        """Forget the last action and the last reward of some envs."""
        for last in (self.last_action, self.last_normalized_reward):
            if last is not None:
                last[envs] = torch.nan

    def store_action(self, action: Any) -> None:
        """Store an action (N, A) as the last action."""
        self.last_action = torch.as_tensor(action, device=self._device).reshape(self._num_envs, -1).clone()

    def change_since_last_step(self, normalized_reward: torch.Tensor) -> torch.Tensor:
        """Return the change (N,) of the normalized reward (N,) since the last step; 0 in the first step."""
        last = normalized_reward if self.last_normalized_reward is None else self.last_normalized_reward
        self.last_normalized_reward = normalized_reward.clone()
        return (normalized_reward - last).nan_to_num()

    def compute(
        self,
        stage_and_terms: tuple[Array, dict[str, Array]],
        penalties: dict[str, Array],
        action: Any,
        info: dict[str, Any],
    ) -> torch.Tensor:
        """Return the dense reward (N,) in [0, ``table.total``], and add ``reward_terms`` to the info.

        Args:
            stage_and_terms: reward stages (N,) and terms by name, as returned by `Goal.stage_and_terms`.
            penalties: values (N,) in [0, 1] by name; this method adds ``action_rate``.
            action: action (N, A) of this step, or None.
            info: info of this step, with ``success`` and ``fail``.
        """
        stage, found = stage_and_terms
        penalties = {**penalties, "action_rate": self._action_rate(action)}
        penalties = {name: penalties[name] for name in self._table.penalties}
        stage = where(to_native(info["success"]), 0 * stage + len(self._table.stages), stage)
        reward, counted = weighted_reward(self._table, stage, found, penalties)
        counted.update(penalties)
        info["reward_terms"] = {name: as_tensor(term) for name, term in counted.items()}
        return as_tensor(reward * ~to_native(info["fail"]))

    def _action_rate(self, action: Any) -> Array:
        last = self.last_action
        if action is None or last is None or last.shape[-1] != action.shape[-1]:
            return to_native(torch.zeros(self._num_envs, device=self._device))
        action = torch.as_tensor(action, device=self._device).reshape(self._num_envs, -1)
        return action_rate(to_native(action), to_native(torch.where(last.isnan(), action, last)))
