"""Dense rewards: named terms in [0, 1], worth what a table says. Pure functions on batched arrays, as `terms`. N envs.

A task is a row of stages, and each env is in one of them at a time. The terms of the stages before it count in full,
those of its own stage as far as they have come, those of later ones not at all. So whatever is in a later stage is
worth at least as much as anything in an earlier one, and going back and forth within a stage earns nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from robocas_ms3.core.arrays import Array, as_float, choose, clamp, length
from robocas_ms3.tasks.occlusion import MAX_HIDDEN_SHARE, MAX_OBSTACLES


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
        """Of all terms."""
        return {name: weight for terms in self.stages.values() for name, weight in terms.items()}

    @cached_property
    def total(self) -> float:
        """What a success is worth."""
        return sum(self.weights.values())

    def index(self, stage: str) -> int:
        """The place of a stage in the row."""
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
    """The reward of envs from the stages that they are in.

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
    return choose(stage >= len(table.stages), none + table.total, reward), counted


def furthest(first: Array, conditions: list[tuple[Array, int]]) -> Array:
    """(N,) stages: that of the last condition (N,) that holds, and where none does, ``first`` (N,)."""
    stage = first
    for condition, place in conditions:
        stage = choose(condition, 0 * stage + place, stage)
    return stage


def closeness(points: Array, goals: Array, *, half: float = 0.1) -> Array:
    """(N,) in (0, 1]: 1 where points (N, 3) are at their goals, a half where they are ``half`` metres away."""
    return half / (half + length(goals - points))


def rise(value: Array, start: Array, by: float) -> Array:
    """(N,) in [0, 1]: how much of the way from its start a value (N,) has risen, of a way of ``by``."""
    return clamp((value - start) / by, 0.0, 1.0)


def uncovered(hidden_share: Array, obstacles: Array, *, many: int = 5) -> Array:
    """(N,) in [0, 1]: 1 where a target is cleared, less the more of it is hidden and the more obstacles are there.

    Args:
        hidden_share: (N,) of the target, see `occlusion.Clutter`.
        obstacles: (N,) how many there are.
        many: as many more than a cleared target may have count as the worst.
    """
    hidden = clamp((hidden_share - MAX_HIDDEN_SHARE) / (1 - MAX_HIDDEN_SHARE), 0.0, 1.0)
    around = clamp((as_float(obstacles) - MAX_OBSTACLES) / many, 0.0, 1.0)
    return 1 - (hidden + around) / 2


def let_go(held: Array, touched: Array) -> Array:
    """(N,) in [0, 1]: 0 while the gripper holds the target, a half while it only touches it, 1 after that."""
    return 1 - (as_float(held) + as_float(held | touched)) / 2


def calm(linear_velocity: Array, angular_velocity: Array, *, linear: float = 0.3, angular: float = 5.0) -> Array:
    """(N,) in [0, 1]: 1 at rest, 0 at velocities (N, 3) of ``linear`` m/s or ``angular`` rad/s and more."""
    return 1 - clamp(length(linear_velocity) / linear + length(angular_velocity) / angular, 0.0, 1.0)


def count_share(count: Array, *, many: int = 3) -> Array:
    """(N,) in [0, 1]: a number of things (N,), 1 from ``many`` on."""
    return clamp(as_float(count) / many, 0.0, 1.0)


def shift(position: Array, position_before: Array, *, limit: float = 0.1) -> Array:
    """(N,) in [0, 1]: how far a body at (N, 3) was shifted, 1 from ``limit`` m on, as far as a basket may go."""
    return clamp(length(position - position_before) / limit, 0.0, 1.0)


def action_rate(action: Array, before: Array, *, span: float = 2.0) -> Array:
    """(N,) in [0, 1]: mean change of an action's components (N, A) since the last one, 1 from ``span`` on."""
    return clamp(abs(action - before).mean(-1) / span, 0.0, 1.0)
