"""Goals: where the target must be for success, one goal per task (`RoboCASEnv.GOAL`).

N envs, K objects. All arrays are native (`core.arrays`): NumPy arrays on a CPU, tensors on a GPU. ``basket_pose`` is
the pose (N, 7) of the basket in the world frame, or None if the scene has no basket.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar, NamedTuple

import torch

from robocas_ms3.core import rotations
from robocas_ms3.core.arrays import Array, known_all_true, to_native
from robocas_ms3.tasks import rewards, terms

_RIM_MARGIN = 0.05  # m around the basket's inner volume in which a falling target still counts as above the basket
_DROP_HEIGHT, _LOWERING = 0.1, 0.25  # m above the basket's rim: end of the carry; start of the lowering
_HALF_REWARD_DISTANCE = 0.2  # m from the end of the carry at which the term `carry` is 0.5


class TaskState(NamedTuple):
    """State of the task at the last call of `RoboCASEnv.evaluate`.

    Attributes:
        object_states: (N, K, 13) states of the objects (`bodies.BODY`).
        basket_pose: (N, 7) pose of the basket in the world frame; None if the scene has no basket.
        target_held: (N,) bool, whether both fingers hold the target.
        target_touched: (N,) bool, whether the gripper touches the target.
        target_at_goal: (N,) bool, whether the target is at the goal.
        disturbed: (N, K) bool, whether each object, except the target, was shifted or knocked over.
        gripper_forces: (N, 3, K, 3) force of each object on left finger, right finger and hand; newtons, world frame.
    """

    object_states: Array
    basket_pose: Array | None
    target_held: Array
    target_touched: Array
    target_at_goal: Array
    disturbed: Array
    gripper_forces: Array


class Goal(ABC):
    """Base class of goals: where the target must be.

    A goal without dense rewards must define only ``NAME`` and `is_at_goal`.

    Args:
        env: the `base.RoboCASEnv`, with a loaded scene.
    """

    NAME: ClassVar[str]
    """Name of the success condition, such as ``in_basket``. The stage of this condition is ``target_in_basket``."""
    REQUIRES_LIFT: ClassVar[bool] = True
    """Whether the target must have been lifted for success."""
    VECTOR_NAME: ClassVar[str] = "target_to_goal"
    """Name of the observation that has the vector from the target's centre of mass to `goal_position`."""

    def __init__(self, env: Any) -> None:
        self.env = env

    @abstractmethod
    def is_at_goal(self, centers: Array, basket_pose: Array | None) -> Array:
        """Return whether centres of mass are at the goal, (N,) or (N, K) bool.

        Args:
            centers: (N, 3) or (N, K, 3) in the world frame, m.
            basket_pose: (N, 7) world pose of the basket, or None.
        """

    def success_conditions(self, basket_pose: Array | None) -> dict[str, Array]:
        """Return success conditions in addition to `is_at_goal`, by name, (N,) bool each; default: none."""
        return {}

    def is_success_impossible(self, basket_pose: Array | None, conditions: dict[str, Array]) -> Array | None:
        """Return (N,) bool, whether the goal can't be reached any more; None: it can be reached in every env.

        Args:
            basket_pose: (N, 7) world pose of the basket, or None.
            conditions: success conditions by name, (N,) bool each.
        """
        return None

    def is_above_goal(self, positions: Array, basket_pose: Array | None) -> Array | None:
        """Return whether targets at positions (N, 3) m are above the goal, (N,) bool; None: no target is."""
        return None

    def goal_position(self, basket_pose: Array | None) -> Array | None:
        """Return the point (N, 3) to which the target is carried, in the world frame, m; None: no point."""
        return None

    def stage_and_terms(
        self, state: TaskState, was_lifted: Array, table: rewards.RewardTable
    ) -> tuple[Array, dict[str, Array]]:
        """Return the current reward stage and reward terms of each env, for dense rewards.

        Args:
            state: current state of the task.
            was_lifted: (N,) bool, whether the target has been lifted since the reset.
            table: reward table of the task.

        Returns:
            Stages (N,) as indices into ``table.stages``, and reward terms by name, (N,) in [0, 1] each.

        Raises:
            NotImplementedError: the goal has no dense rewards. Its environment must omit the dense modes in
                ``SUPPORTED_REWARD_MODES``.
        """
        fix = 'define the method stage_and_terms, or pass reward_mode="sparse"'
        raise NotImplementedError(f"the goal {type(self).__name__} has no dense rewards: {fix}")

    def penalties(self, state: TaskState) -> dict[str, Array]:
        """Return penalties of dense rewards by name, (N,) in [0, 1] each; default: none."""
        return {}


class InBasketGoal(Goal):
    """Goal of the standard tasks: the target's centre of mass is in the inner volume of a standing basket.

    The goal can't be reached any more after the basket has fallen: it is 10 cm lower than at the start, or tilted by
    60 degrees.
    """

    NAME = "in_basket"
    VECTOR_NAME = "target_to_drop"

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        assert env.model.basket is not None, "the scene has no basket"
        inner = env.model.basket.asset.inner
        assert inner is not None  # checked when the model is loaded
        low, high = (torch.tensor(corner, device=env.device) for corner in (inner.min, inner.max))
        aside = torch.tensor([_RIM_MARGIN, _RIM_MARGIN, torch.inf], device=env.device)
        self._inside = to_native(low), to_native(high)
        self._above = to_native(low - aside), to_native(high + aside)
        self._drop = to_native(torch.cat([(low + high)[:2] / 2, high[2:] + _DROP_HEIGHT]))  # in the basket's frame

    def is_at_goal(self, centers: Array, basket_pose: Array | None) -> Array:
        return terms.is_inside_box(centers, *_split_pose(basket_pose), *self._inside)

    def goal_position(self, basket_pose: Array | None) -> Array:
        """Return the point (N, 3) 10 cm above the middle of the basket's rim, m, world frame."""
        position, quaternion = _split_pose(basket_pose)
        return position + rotations.rotate(quaternion, self._drop)

    def success_conditions(self, basket_pose: Array | None) -> dict[str, Array]:
        start = to_native(self.env.basket_start_poses)
        return {"basket_stands": terms.is_basket_standing(*_split_pose(basket_pose), *_split_pose(start))}

    def is_success_impossible(self, basket_pose: Array | None, conditions: dict[str, Array]) -> Array | None:
        if known_all_true(conditions["basket_stands"]):  # the usual case
            return None
        start = to_native(self.env.basket_start_poses)
        over = terms.has_basket_fallen(*_split_pose(basket_pose), *_split_pose(start))
        return over & ~conditions["basket_stands"]

    def is_above_goal(self, positions: Array, basket_pose: Array | None) -> Array | None:
        """Return whether targets at positions (N, 3) m are above the inside of the basket, (N,) bool."""
        return terms.is_inside_box(positions, *_split_pose(basket_pose), *self._above)

    def stage_and_terms(
        self, state: TaskState, was_lifted: Array, table: rewards.RewardTable
    ) -> tuple[Array, dict[str, Array]]:
        """Return the index (N,) of the reward stage, from grasp to rest, and the terms (N,) by name."""
        env = self.env
        slot = to_native(env.target_slot)
        target, center = terms.select_target(state.object_states, slot), env.target_center(state.object_states)
        basket, turned = _split_pose(state.basket_pose)
        inside = rotations.rotate_inverse(turned, center - basket)  # the target in the basket's frame
        low, high = self._inside
        over = ((inside[:, :2] >= low[:2]) & (inside[:, :2] <= high[:2])).all(-1) & (inside[:, 2] >= low[2])  # pyright: ignore[reportOperatorIssue]
        delivered = was_lifted & state.target_at_goal
        stage = rewards.furthest_stage(
            0 * slot + table.stage_index("grasp"),
            [
                (state.target_held, table.stage_index("lift")),
                # not by the current height: the basket may be lower than the start of the target
                (state.target_held & was_lifted, table.stage_index("carry")),
                (was_lifted & over, table.stage_index("place")),
                (delivered, table.stage_index("release")),
                (delivered & ~state.target_touched, table.stage_index("rest")),
            ],
        )
        start = terms.select_target(to_native(env.start_poses)[..., 2], slot)
        return stage, {
            "reach": rewards.nearness(env.tcp_in_world()[:, :3], center),
            "lift": rewards.change_fraction(target[:, 2], start, terms.LIFT),
            "carry": rewards.nearness(
                center, self.goal_position(state.basket_pose), half_distance=_HALF_REWARD_DISTANCE
            ),
            "place": 1 - rewards.change_fraction(inside[:, 2], high[2], _LOWERING),
            "released": rewards.release_fraction(state.target_held, state.target_touched),
            "at_rest": rewards.stillness(target[:, 7:10], target[:, 10:]),
        }

    def penalties(self, state: TaskState) -> dict[str, Array]:
        return {
            "basket_shift": rewards.basket_shift_fraction(
                _split_pose(state.basket_pose)[0], to_native(self.env.basket_start_poses)[:, :3]
            )
        }


def _split_pose(pose: Array | None) -> tuple[Array, Array]:
    """Return the positions (N, 3) and quaternions (N, 4) of basket poses (N, 7)."""
    assert pose is not None, "the scene has no basket"
    return pose[:, :3], pose[:, 3:]
