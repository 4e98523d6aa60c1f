"""Dense rewards: named terms in [0, 1], weighed by a task's table. Pure functions on arrays, as `terms`. N envs.

A task is a row of stages, and each env is in one of them at a time. The terms of the stages before it count in full,
those of its own stage as far as they have come, those of later ones not at all. So whatever is in a later stage is
worth at least as much as anything in an earlier one, and going back and forth within a stage earns nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch

from robocas_ms3.core.arrays import Array, as_float, as_tensor, clamp, norm, to_native, where
from robocas_ms3.tasks.occlusion import MAX_HIDDEN_FRACTION, MAX_OBSTACLES
from robocas_ms3.tasks.terms import BASKET_SHIFT

_MANY_OBSTACLES = 5  # more than a cleared target may have: counts as the worst
DENSE = ("normalized_dense", "dense", "progress")  # reward modes whose terms are computed


@dataclass(frozen=True)
class RewardTable:
    """What a task's reward is made of.

    Attributes:
        stages: by name, in the order in which they are passed: the terms that count in each, and their weights.
        penalties: by name, what share of the present stage's terms each takes off at most; they add up to less than 1.
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


def weigh(
    table: RewardTable, stage: Array, terms: dict[str, Array], penalties: dict[str, Array]
) -> tuple[Array, dict[str, Array]]:
    """Return the reward of envs from the stages that they are in.

    Args:
        table: of the task.
        stage: (N,) whole numbers, places in ``table.stages``; their count where the task has succeeded.
        terms: by name, (N,) in [0, 1], how far each has come; what is missing has not come anywhere in its own stage.
        penalties: by name, (N,) in [0, 1].

    Returns:
        (N,) in [0, ``table.total``], and all terms by name as they count, (N,) in [0, 1].
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
    """(N,) stages: that of the last condition (N,) that holds, and where none does, ``first`` (N,)."""
    stage = first
    for condition, place in conditions:
        stage = where(condition, 0 * stage + place, stage)
    return stage


def closeness(points: Array, goals: Array, *, half: float = 0.1) -> Array:
    """(N,) in (0, 1]: 1 where points (N, 3) are at their goals, a half where they are ``half`` metres away."""
    return half / (half + norm(goals - points))


def progress_fraction(value: Array, start: Array | float, by: float) -> Array:
    """(N,) in [0, 1]: how much of the way from its start a value (N,) has risen, of a way of ``by``."""
    return clamp((value - start) / by, 0.0, 1.0)


def clear_fraction(hidden_fraction: Array, obstacles: Array) -> Array:
    """(N,) in [0, 1]: 1 where a target is cleared, less the more of it is hidden (N,) and the more obstacles (N,)."""
    hidden = clamp((hidden_fraction - MAX_HIDDEN_FRACTION) / (1 - MAX_HIDDEN_FRACTION), 0.0, 1.0)
    around = clamp((as_float(obstacles) - MAX_OBSTACLES) / _MANY_OBSTACLES, 0.0, 1.0)
    return 1 - (hidden + around) / 2


def release_fraction(held: Array, touched: Array) -> Array:
    """(N,) in [0, 1]: 0 while the gripper holds the target, a half while it only touches it, 1 after that."""
    return 1 - (as_float(held) + as_float(held | touched)) / 2


def stillness(linear_velocity: Array, angular_velocity: Array) -> Array:
    """(N,) in [0, 1]: 1 at rest, 0 at velocities (N, 3) of 0.3 m/s or 5 rad/s and more."""
    return 1 - clamp(norm(linear_velocity) / 0.3 + norm(angular_velocity) / 5.0, 0.0, 1.0)


def count_fraction(count: Array) -> Array:
    """(N,) in [0, 1]: a number of things (N,), 1 from 3 on."""
    return clamp(as_float(count) / 3, 0.0, 1.0)


def shift_fraction(position: Array, position_before: Array) -> Array:
    """(N,) in [0, 1]: how far a body at (N, 3) was shifted, 1 from 0.1 m on, as far as a basket may go."""
    return clamp(norm(position - position_before) / BASKET_SHIFT, 0.0, 1.0)


def action_rate(action: Array, before: Array) -> Array:
    """(N,) in [0, 1]: mean change of an action's components (N, A) since the last one, 1 from 2 on."""
    return clamp(abs(action - before).mean(-1) / 2.0, 0.0, 1.0)


class DenseReward:
    """Weighs terms and penalties, and remembers the last action and reward.

    Attributes:
        last_action: (N, A), NaN where there was none since the reset; None: none yet.
        last_level: (N,) last normalized reward of the mode ``progress``, NaN where there was none since the reset.
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
        """Return how much a reward (N,) has risen since the last step; 0 in the first one."""
        before = level if self.last_level is None else self.last_level
        self.last_level = level.clone()
        return (level - before).nan_to_num()

    def weigh(
        self, progress: tuple[Array, dict[str, Array]], penalties: dict[str, Array], action: Any, info: dict[str, Any]
    ) -> torch.Tensor:
        """Return the reward (N,) in [0, total of the table], and add ``reward_terms`` to the info.

        Args:
            progress: stages and terms, see `Goal.progress`.
            penalties: by name, (N,) in [0, 1] each, native (`arrays`); the action's rate is added.
            action: of this step.
            info: of this step, from `RoboCASEnv.evaluate`.
        """
        stage, found = progress
        penalties = {**penalties, "action_rate": self._action_rate(action)}
        penalties = {name: penalties[name] for name in self._table.penalties}
        stage = where(to_native(info["success"]), 0 * stage + len(self._table.stages), stage)
        reward, counted = weigh(self._table, stage, found, penalties)
        counted.update(penalties)
        info["reward_terms"] = {name: as_tensor(term) for name, term in counted.items()}
        return as_tensor(reward * ~to_native(info["fail"]))

    def _action_rate(self, action: Any) -> Array:
        before = self.last_action
        if action is None or before is None or before.shape[-1] != action.shape[-1]:
            return to_native(torch.zeros(self._num_envs, device=self._device))
        action = torch.as_tensor(action, device=self._device).reshape(self._num_envs, -1)
        return action_rate(to_native(action), to_native(torch.where(before.isnan(), action, before)))
