"""Where targets have to end up, one goal per task (`RoboCASEnv.GOAL`); that of the benchmark is the basket.

N envs, K objects; all arrays native (`arrays`). ``basket`` is the pose (N, 7) of the scene's basket in the world; None
where it has none.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar, NamedTuple

import torch

from robocas_ms3.core import rotations
from robocas_ms3.core.arrays import Array, known_all_true, to_native
from robocas_ms3.tasks import rewards, terms

_RIM = 0.05  # m around the basket's inside that still count as over it for a target that falls
_DROP_HEIGHT, _LOWERING = 0.1, 0.25  # m above the basket's rim: where a carry leads; from where on lowering counts
_FAR = 0.2  # m from there at which half of the carry is done


class TaskState(NamedTuple):
    """What `RoboCASEnv.evaluate` found last.

    Attributes:
        objects: (N, K, 13) their states.
        basket: (N, 7) its pose in the world; None where there is none.
        held: (N,) bool, whether the target is held; so are the next ones.
        touched: the gripper touches it.
        at_goal: it is where it has to end up.
        disturbed: (N, K) bool, which objects other than the target no longer stand as they stood.
        forces: (N, 3, K, 3) N, of objects on left finger, right finger and hand, world frame.
    """

    objects: Array
    basket: Array | None
    held: Array
    touched: Array
    at_goal: Array
    disturbed: Array
    forces: Array


class Goal(ABC):
    """A goal of one environment, made when its scene is. Only ``holds`` is needed for sparse rewards.

    Args:
        env: the `base.RoboCASEnv`.
    """

    NAME: ClassVar[str]
    """Of its measure, ``in_basket``; the stage is ``target_in_basket``."""
    REQUIRES_LIFT: ClassVar[bool] = True
    """Whether the target must have been lifted for success."""
    VECTOR_NAME: ClassVar[str] = "target_to_goal"
    """Name of the observation of the way from the target's centre of mass to `point`."""

    def __init__(self, env: Any) -> None:
        self.env = env

    @abstractmethod
    def is_at_goal(self, centers: Array, basket: Array | None) -> Array:
        """Return which objects are at the goal, (N,) or (N, K), from their centres of mass (N, 3) or (N, K, 3)."""

    def success_conditions(self, basket: Array | None) -> dict[str, Array]:
        """Return what else has to hold at the moment of success: (N,) bool each."""
        return {}

    def is_lost(self, basket: Array | None, measures: dict[str, Array]) -> Array | None:
        """Return in which envs (N,) the goal itself can't be reached any more; None: in none."""
        return None

    def is_over_goal(self, positions: Array, basket: Array | None) -> Array | None:
        """Return which targets at (N, 3) m may be lower than where they stood, (N,) bool; None: none may."""
        return None

    def position(self, basket: Array | None) -> Array | None:
        """Return where the target's centre of mass is to be brought, (N, 3) m in the world; None: not at one point."""
        return None

    def progress(self, now: TaskState, brought: Array, table: rewards.RewardTable) -> tuple[Array, dict[str, Array]]:
        """Return how far an episode is, for dense rewards.

        Args:
            now: what `RoboCASEnv.evaluate` found.
            brought: (N,) bool, whether the target has been lifted.
            table: the task's.

        Returns:
            Stages (N,) of the table, and the terms that count in them by name, (N,) in [0, 1] each.

        Raises:
            NotImplementedError: the goal has no dense rewards; its task lists none in ``SUPPORTED_REWARD_MODES``.
        """
        raise NotImplementedError(f"{type(self).__name__} has no dense rewards")

    def penalties(self, now: TaskState) -> dict[str, Array]:
        """Return penalties of dense rewards by name, (N,) in [0, 1] each."""
        return {}


class InBasket(Goal):
    """The target's centre of mass is in the basket's inner volume, and the basket stands.

    Lost where the basket has fallen: 10 cm lower, or tilted by 60 deg.
    """

    NAME = "in_basket"
    VECTOR_NAME = "target_to_drop"

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        assert env.model.basket is not None, "the scene has no basket"
        inner = env.model.basket.asset.inner
        assert inner is not None  # the model saw to it
        low, high = (torch.tensor(corner, device=env.device) for corner in (inner.min, inner.max))
        aside = torch.tensor([_RIM, _RIM, torch.inf], device=env.device)
        self._inside = to_native(low), to_native(high)
        self._above = to_native(low - aside), to_native(high + aside)
        self._drop = to_native(torch.cat([(low + high)[:2] / 2, high[2:] + _DROP_HEIGHT]))  # in the basket's frame

    def is_at_goal(self, centers: Array, basket: Array | None) -> Array:
        return terms.is_inside_box(centers, *_split(basket), *self._inside)

    def position(self, basket: Array | None) -> Array:
        """See `Goal`: over the middle of the basket's rim."""
        position, quaternion = _split(basket)
        return position + rotations.rotate(quaternion, self._drop)

    def success_conditions(self, basket: Array | None) -> dict[str, Array]:
        start = to_native(self.env.basket_start_poses)
        return {"basket_stands": terms.is_basket_standing(*_split(basket), *_split(start))}

    def is_lost(self, basket: Array | None, measures: dict[str, Array]) -> Array | None:
        if known_all_true(measures["basket_stands"]):  # as nearly always
            return None
        start = to_native(self.env.basket_start_poses)
        over = terms.has_basket_fallen(*_split(basket), *_split(start))
        return over & ~measures["basket_stands"]

    def is_over_goal(self, positions: Array, basket: Array | None) -> Array | None:
        """See `Goal`: those above the basket."""
        return terms.is_inside_box(positions, *_split(basket), *self._above)

    def progress(self, now: TaskState, brought: Array, table: rewards.RewardTable) -> tuple[Array, dict[str, Array]]:
        """See `Goal`: grasp, lift, carry, place, release, rest."""
        env = self.env
        slot = to_native(env.target_slot)
        target, center = terms.select_target(now.objects, slot), env.target_center(now.objects)
        basket, turned = _split(now.basket)
        inside = rotations.rotate_inverse(turned, center - basket)  # the target in the basket's frame
        low, high = self._inside
        over = ((inside[:, :2] >= low[:2]) & (inside[:, :2] <= high[:2])).all(-1) & (inside[:, 2] >= low[2])  # pyright: ignore[reportOperatorIssue]
        delivered = brought & now.at_goal
        stage = rewards.furthest_stage(
            0 * slot + table.index("grasp"),
            [
                (now.held, table.index("lift")),
                # a basket may stand lower than where the target stood
                (now.held & brought, table.index("carry")),
                (brought & over, table.index("place")),
                (delivered, table.index("release")),
                (delivered & ~now.touched, table.index("rest")),
            ],
        )
        start = terms.select_target(to_native(env.start_poses)[..., 2], slot)
        return stage, {
            "reach": rewards.closeness(env.tcp_in_world()[:, :3], center),
            "lift": rewards.progress_fraction(target[:, 2], start, terms.LIFT),
            "carry": rewards.closeness(center, self.position(now.basket), half=_FAR),
            "place": 1 - rewards.progress_fraction(inside[:, 2], high[2], _LOWERING),
            "released": rewards.release_fraction(now.held, now.touched),
            "at_rest": rewards.stillness(target[:, 7:10], target[:, 10:]),
        }

    def penalties(self, now: TaskState) -> dict[str, Array]:
        return {
            "basket_shift": rewards.shift_fraction(_split(now.basket)[0], to_native(self.env.basket_start_poses)[:, :3])
        }


def _split(basket: Array | None) -> tuple[Array, Array]:
    """Return position and quaternion of poses (N, 7)."""
    assert basket is not None, "the scene has no basket"
    return basket[:, :3], basket[:, 3:]
