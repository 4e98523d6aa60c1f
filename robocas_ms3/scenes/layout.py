"""What a layout is: where everything stands at the beginning of an episode. No simulator."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

ObjectIds = tuple[str, ...]
"""Objects of a scene, one id of the object pack a slot."""

_SKEW = 1e-3  # by which a rotation may differ from one, as single precision does
PARKING_HEIGHT = -5.0  # z of the plane, m, on which slots wait that an episode does not use


@dataclass(frozen=True)
class Layout:
    """A settled arrangement of objects and its target. K objects; world frame, metres.

    Attributes:
        object_ids: K ids of the object pack, one a slot.
        object_poses: (K, 4, 4) objects in the world, at rest; of those that aren't present, where they wait.
        robot_pose: (4, 4) the robot's root on the floor, in the world.
        basket_pose: (4, 4) the basket's frame in the world; None where there is no basket.
        target: slot of the target.
        relation: how the instruction tells the target from its likes, e.g. ``nearest``; empty where its name does.
        present: (K,) which slots take part; default: all. Slots are as many for every seed, their use may vary.
        visible_shares: (K,) p_vis of each object from the selection camera; NaN where it was not asked for.
    """

    object_ids: ObjectIds
    object_poses: Array
    robot_pose: Array
    basket_pose: Array | None
    target: int
    relation: str = ""
    present: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))
    visible_shares: Array = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        if len(self.present) == 0:
            object.__setattr__(self, "present", np.ones(len(self.object_ids), dtype=bool))
        if len(self.visible_shares) == 0:
            object.__setattr__(self, "visible_shares", np.full(len(self.object_ids), np.nan))

    def check(self, names: Collection[str]) -> None:
        """See that it can be built, whoever wrote it.

        Args:
            names: ids of the object pack's objects.

        Raises:
            ValueError: it can't, saying why.
        """
        count = len(self.object_ids)
        shapes = self.object_poses.shape, self.present.shape, self.visible_shares.shape
        if shapes != ((count, 4, 4), (count,), (count,)) or not set(self.object_ids) <= set(names):
            raise ValueError("other objects than those of the pack, or not as many poses as objects")
        others = [self.robot_pose] if self.basket_pose is None else [self.robot_pose, self.basket_pose]
        if any(pose.shape != (4, 4) for pose in others) or not 0 <= self.target < count:
            raise ValueError("a pose is no 4x4, or the target none of the objects")
        poses = np.concatenate([self.object_poses, others])
        turns = poses[:, :3, :3]
        if not np.isfinite(poses).all() or np.abs(turns @ turns.swapaxes(1, 2) - np.eye(3)).max() > _SKEW:
            raise ValueError("a pose is no pose")
