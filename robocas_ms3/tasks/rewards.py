"""Dense rewards: named terms in [0, 1], weighted by a task's table. N envs; arrays as in `terms`.

A task is a sequence of stages, and each env is in one stage at a time. Terms of earlier stages count in full, terms of
the current stage count with their values, terms of later stages don't count. So a later stage always has at least the
reward of an earlier one.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch

from robocas_ms3.core.arrays import Array, as_float, as_tensor, clamp, norm, to_native, where
from robocas_ms3.tasks.occlusion import MAX_HIDDEN_FRACTION, MAX_OBSTACLES
from robocas_ms3.tasks.terms import BASKET_SHIFT

_MANY_OBSTACLES = 5  # obstacles in addition to those of a cleared target at which the fraction is 0
DENSE = ("normalized_dense", "dense", "progress")  # reward modes whose terms are computed


@dataclass(frozen=True)
class RewardTable:
    """Stages, weights and penalties of a task's dense reward.

    Attributes:
        stages: weights of the terms of each stage; stages by name, in their order.
        penalties: greatest fraction of the current stage's terms that each penalty subtracts; the sum is below 1.
    """

    stages: dict[str, dict[str, float]]
    penalties: dict[str, float]

    @cached_property
    def weights(self) -> dict[str, float]:
        return {name: weight for terms in self.stages.values() for name, weight in terms.items()}

    @cached_property
    def total(self) -> float:
        return sum(self.weights.values())

    def index(self, stage: str) -> int:
        return list(self.stages).index(stage)


_TRANSFER = {
    "grasp": {"reach": 2.0, "grasp": 2.0},
    "lift": {"lift": 1.0},
    "carry": {"carry": 2.0},
    "place": {"place": 1.0},
    "release": {"released": 0.5},
    "rest": {"at_rest": 0.5, "success": 1.0},
}
TRANSFER = RewardTable(_TRANSFER, {"disturbed": 0.1, "basket_shift": 0.1, "action_rate": 0.05})
# a heap is disturbed on purpose
SEARCH = RewardTable(
    {"clear": {"push_point": 1.0, "clear": 3.0}, **_TRANSFER}, {"basket_shift": 0.1, "action_rate": 0.05}
)
OPEN_PICK = RewardTable({"open": {"handle": 1.0, "open": 3.0}, **_TRANSFER}, TRANSFER.penalties)


def weighted_reward(
    table: RewardTable, stage: Array, terms: dict[str, Array], penalties: dict[str, Array]
) -> tuple[Array, dict[str, Array]]:
    """Return the weighted reward of envs from their stages and terms.

    Args:
        table: reward table of the task.
        stage: (N,) indices into ``table.stages``; the number of stages for envs that have succeeded.
        terms: values (N,) in [0, 1] of the terms by name; a missing term is 0 in its own stage.
        penalties: values (N,) in [0, 1] of the penalties by name.

    Returns:
        Rewards (N,) in [0, ``table.total``], and the counted values (N,) in [0, 1] of all terms by name.
    """
    none = 0.0 * as_float(stage)
    kept = 1.0 - sum((share * penalties[name] for name, share in table.penalties.items()), none)
    counted, reward = {}, none
    for place, own in enumerate(table.stages.values()):
        passed, here = as_float(stage > place), as_float(stage == place) * kept
        for name, weight in own.items():
            counted[name] = passed + here * terms.get(name, none)
            reward = reward + weight * counted[name]
    return where(stage >= len(table.stages), none + table.total, reward), counted


def furthest_stage(first: Array, conditions: list[tuple[Array, int]]) -> Array:
    """Return (N,) the stage of the last condition (N,) that is true, or ``first`` (N,) if none is."""
    stage = first
    for condition, place in conditions:
        stage = where(condition, 0 * stage + place, stage)
    return stage


def closeness(points: Array, goals: Array, *, half: float = 0.1) -> Array:
    """Return (N,) in (0, 1]: 1 for points (N, 3) at their goals, 0.5 at a distance of ``half`` metres."""
    return half / (half + norm(goals - points))


def progress_fraction(value: Array, start: Array | float, by: float) -> Array:
    """Return (N,) in [0, 1]: change of a value (N,) since its start, as a fraction of the change ``by``."""
    return clamp((value - start) / by, 0.0, 1.0)


def clear_fraction(hidden_fraction: Array, obstacles: Array) -> Array:
    """Return (N,) in [0, 1]: 1 for a cleared target, less with hidden fraction (N,) and obstacles (N,)."""
    hidden = clamp((hidden_fraction - MAX_HIDDEN_FRACTION) / (1 - MAX_HIDDEN_FRACTION), 0.0, 1.0)
    around = clamp((as_float(obstacles) - MAX_OBSTACLES) / _MANY_OBSTACLES, 0.0, 1.0)
    return 1 - (hidden + around) / 2


def release_fraction(held: Array, touched: Array) -> Array:
    """Return (N,): 0 while the gripper holds the target, 0.5 while it only touches it, 1 without contact."""
    return 1 - (as_float(held) + as_float(held | touched)) / 2


def stillness(linear_velocity: Array, angular_velocity: Array) -> Array:
    """Return (N,) in [0, 1]: 1 at rest, 0 at velocities (N, 3) of at least 0.3 m/s or 5 rad/s."""
    return 1 - clamp(norm(linear_velocity) / 0.3 + norm(angular_velocity) / 5.0, 0.0, 1.0)


def count_fraction(count: Array) -> Array:
    """Return (N,) in [0, 1]: a count (N,) divided by 3, at most 1."""
    return clamp(as_float(count) / 3, 0.0, 1.0)


def shift_fraction(position: Array, position_before: Array) -> Array:
    """Return (N,) in [0, 1]: shift of a body at (N, 3), relative to the 0.1 m that a basket may be moved."""
    return clamp(norm(position - position_before) / BASKET_SHIFT, 0.0, 1.0)


def action_rate(action: Array, before: Array) -> Array:
    """Return (N,) in [0, 1]: half the mean change of an action's components (N, A) since the last action."""
    return clamp(abs(action - before).mean(-1) / 2.0, 0.0, 1.0)


class DenseReward:
    """The dense reward of an environment, with the last action and reward.

    Attributes:
        last_action: (N, A) last action since the reset, NaN: none; None before the first action.
        last_level: (N,) last normalized reward since the reset in the mode ``progress``, NaN: none; None before the
            first reward.
    """

    def __init__(self, table: RewardTable, num_envs: int, device: torch.device) -> None:
        self._table, self._num_envs, self._device = table, num_envs, device
        self.last_action: torch.Tensor | None = None
        self.last_level: torch.Tensor | None = None

    def reset(self, envs: Any) -> None:
        for last in (self.last_action, self.last_level):
            if last is not None:
                last[envs] = torch.nan

    def store_action(self, action: Any) -> None:
        self.last_action = torch.as_tensor(action, device=self._device).reshape(self._num_envs, -1).clone()

    def increase(self, level: torch.Tensor) -> torch.Tensor:
        """Return the change of a reward (N,) since the last step; 0 in the first step."""
        before = level if self.last_level is None else self.last_level
        self.last_level = level.clone()
        return (level - before).nan_to_num()

    def compute(
        self, progress: tuple[Array, dict[str, Array]], penalties: dict[str, Array], action: Any, info: dict[str, Any]
    ) -> torch.Tensor:
        """Return the reward (N,) in [0, ``table.total``], and add ``reward_terms`` to the info.

        Args:
            progress: stages and terms, see `Goal.progress`.
            penalties: values (N,) in [0, 1] by name, native (`arrays`); ``action_rate`` is added to them.
            action: action of this step.
            info: info of this step, from `RoboCASEnv.evaluate`.
        """
        stage, found = progress
        penalties = {**penalties, "action_rate": self._action_rate(action)}
        penalties = {name: penalties[name] for name in self._table.penalties}
        stage = where(to_native(info["success"]), 0 * stage + len(self._table.stages), stage)
        reward, counted = weighted_reward(self._table, stage, found, penalties)
        counted.update(penalties)
        info["reward_terms"] = {name: as_tensor(term) for name, term in counted.items()}
        return as_tensor(reward * ~to_native(info["fail"]))

    def _action_rate(self, action: Any) -> Array:
        before = self.last_action
        if action is None or before is None or before.shape[-1] != action.shape[-1]:
            return to_native(torch.zeros(self._num_envs, device=self._device))
        action = torch.as_tensor(action, device=self._device).reshape(self._num_envs, -1)
        return action_rate(to_native(action), to_native(torch.where(before.isnan(), action, before)))
