"""Goals: where the target must be for success, one goal per task (`RoboCASEnv.GOAL`).

N envs, K objects; all arrays are native (`arrays`). ``basket`` is the pose (N, 7) of the basket in the world, or None.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar, NamedTuple

import torch

from robocas_ms3.core import rotations
from robocas_ms3.core.arrays import Array, known_all_true, to_native
from robocas_ms3.tasks import rewards, terms

_RIM = 0.05  # m around the basket's inside in which a falling target still counts as above the basket
_DROP_HEIGHT, _LOWERING = 0.1, 0.25  # m above the basket's rim: end of the carry; start of the lowering
_FAR = 0.2  # m from the end of the carry at which its reward is a half


class TaskState(NamedTuple):
    """State of the task at the last `RoboCASEnv.evaluate`.

    Attributes:
        objects: (N, K, 13) states of the objects.
        basket: (N, 7) pose of the basket in the world; None if the scene has none.
        held: (N,) bool, whether both fingers hold the target.
        touched: (N,) bool, whether the gripper touches the target.
        at_goal: (N,) bool, whether the target is at the goal.
        disturbed: (N, K) bool, which objects other than the target were shifted or knocked over.
        forces: (N, 3, K, 3) N, forces of objects on left finger, right finger and hand, world frame.
    """

    objects: Array
    basket: Array | None
    held: Array
    touched: Array
    at_goal: Array
    disturbed: Array
    forces: Array


class Goal(ABC):
    """The goal of an environment, created with its scene. Sparse rewards need only ``is_at_goal``.

    Args:
        env: the `base.RoboCASEnv`.
    """

    NAME: ClassVar[str]
    """Name of its success condition, e.g. ``in_basket``; the stage is ``target_in_basket``."""
    REQUIRES_LIFT: ClassVar[bool] = True
    """Whether the target must have been lifted for success."""
    VECTOR_NAME: ClassVar[str] = "target_to_goal"
    """Name of the observation of the vector from the target's centre of mass to `position`."""

    def __init__(self, env: Any) -> None:
        self.env = env

    @abstractmethod
    def is_at_goal(self, centers: Array, basket: Array | None) -> Array:
        """Return (N,) or (N, K) which objects are at the goal, from centres of mass (N, 3) or (N, K, 3)."""

    def success_conditions(self, basket: Array | None) -> dict[str, Array]:
        """Return additional conditions of success by name, (N,) bool each."""
        return {}

    def is_lost(self, basket: Array | None, conditions: dict[str, Array]) -> Array | None:
        """Return (N,) in which envs the goal can't be reached any more; None: in no env."""
        return None

    def is_over_goal(self, positions: Array, basket: Array | None) -> Array | None:
        """Return (N,) which targets at positions (N, 3) m are above the goal; None: no target."""
        return None

    def position(self, basket: Array | None) -> Array | None:
        """Return the position (N, 3) m, world, to which the target is carried; None: no fixed one."""
        return None

    def progress(
        self, state: TaskState, was_lifted: Array, table: rewards.RewardTable
    ) -> tuple[Array, dict[str, Array]]:
        """Return the current stage and reward terms, for dense rewards.

        Args:
            state: state of the task.
            was_lifted: (N,) bool, whether the target has been lifted.
            table: reward table of the task.

        Returns:
            Stages (N,) as indices into ``table.stages``, and reward terms by name, (N,) in [0, 1] each.

        Raises:
            NotImplementedError: the goal has no dense rewards; its task omits them in ``SUPPORTED_REWARD_MODES``.
        """
        raise NotImplementedError(f"{type(self).__name__} has no dense rewards")

    def penalties(self, state: TaskState) -> dict[str, Array]:
        """Return penalties of dense rewards by name, (N,) in [0, 1] each."""
        return {}


class InBasket(Goal):
    """The target's centre of mass is in the basket's inner volume, and the basket stands.

    The goal is lost if the basket has fallen: it is 10 cm lower, or tilted by 60 deg.
    """

    NAME = "in_basket"
    VECTOR_NAME = "target_to_drop"

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        assert env.model.basket is not None, "the scene has no basket"
        inner = env.model.basket.asset.inner
        assert inner is not None  # checked when the model is loaded
        low, high = (torch.tensor(corner, device=env.device) for corner in (inner.min, inner.max))
        aside = torch.tensor([_RIM, _RIM, torch.inf], device=env.device)
        self._inside = to_native(low), to_native(high)
        self._above = to_native(low - aside), to_native(high + aside)
        self._drop = to_native(torch.cat([(low + high)[:2] / 2, high[2:] + _DROP_HEIGHT]))  # in the basket's frame

    def is_at_goal(self, centers: Array, basket: Array | None) -> Array:
        return terms.is_inside_box(centers, *_split(basket), *self._inside)

    def position(self, basket: Array | None) -> Array:
        """Return the position above the middle of the basket's rim; see `Goal`."""
        position, quaternion = _split(basket)
        return position + rotations.rotate(quaternion, self._drop)

    def success_conditions(self, basket: Array | None) -> dict[str, Array]:
        start = to_native(self.env.basket_start_poses)
        return {"basket_stands": terms.is_basket_standing(*_split(basket), *_split(start))}

    def is_lost(self, basket: Array | None, conditions: dict[str, Array]) -> Array | None:
        if known_all_true(conditions["basket_stands"]):  # as nearly always
            return None
        start = to_native(self.env.basket_start_poses)
        over = terms.has_basket_fallen(*_split(basket), *_split(start))
        return over & ~conditions["basket_stands"]

    def is_over_goal(self, positions: Array, basket: Array | None) -> Array | None:
        """Return which targets are above the basket; see `Goal`."""
        return terms.is_inside_box(positions, *_split(basket), *self._above)

    def progress(
        self, state: TaskState, was_lifted: Array, table: rewards.RewardTable
    ) -> tuple[Array, dict[str, Array]]:
        """Return the stage (grasp, lift, carry, place, release, rest) and the terms; see `Goal`."""
        env = self.env
        slot = to_native(env.target_slot)
        target, center = terms.select_target(state.objects, slot), env.target_center(state.objects)
        basket, turned = _split(state.basket)
        inside = rotations.rotate_inverse(turned, center - basket)  # the target in the basket's frame
        low, high = self._inside
        over = ((inside[:, :2] >= low[:2]) & (inside[:, :2] <= high[:2])).all(-1) & (inside[:, 2] >= low[2])  # pyright: ignore[reportOperatorIssue]
        delivered = was_lifted & state.at_goal
        stage = rewards.furthest_stage(
            0 * slot + table.index("grasp"),
            [
                (state.held, table.index("lift")),
                # the basket may be lower than the target's start
                (state.held & was_lifted, table.index("carry")),
                (was_lifted & over, table.index("place")),
                (delivered, table.index("release")),
                (delivered & ~state.touched, table.index("rest")),
            ],
        )
        start = terms.select_target(to_native(env.start_poses)[..., 2], slot)
        return stage, {
            "reach": rewards.closeness(env.tcp_in_world()[:, :3], center),
            "lift": rewards.progress_fraction(target[:, 2], start, terms.LIFT),
            "carry": rewards.closeness(center, self.position(state.basket), half=_FAR),
            "place": 1 - rewards.progress_fraction(inside[:, 2], high[2], _LOWERING),
            "released": rewards.release_fraction(state.held, state.touched),
            "at_rest": rewards.stillness(target[:, 7:10], target[:, 10:]),
        }

    def penalties(self, state: TaskState) -> dict[str, Array]:
        return {
            "basket_shift": rewards.shift_fraction(
                _split(state.basket)[0], to_native(self.env.basket_start_poses)[:, :3]
            )
        }


def _split(basket: Array | None) -> tuple[Array, Array]:
    """Return position and quaternion of poses (N, 7)."""
    assert basket is not None, "the scene has no basket"
    return basket[:, :3], basket[:, 3:]
