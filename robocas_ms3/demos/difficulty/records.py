"""Difficulty of a scene, and the limits of the search for removals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from robocas_ms3.core.checks import MAX_SEED

Count = Annotated[int, Field(ge=0)]


@dataclass(frozen=True)
class SceneDifficulty:
    """Difficulty of the scene of a seed for its target.

    Attributes:
        seed: seed of the scene.
        target: id of the target in its pack.
        objects: number of objects.
        visible_fraction: fraction of the target that no other object hides, seen from above.
        obstacles: number of obstacles around the target, by the rule of ``obstacles_cleared``.
        free_grasps: number of annotated grasps of the target, of at most 150 tested ones, whose gripper touches no
            object and no furniture.
        fewest_blockers: smallest number of objects that the gripper touches in one of the tested grasps; the number of
            all other objects if no grasp has a suitable direction and width.
        gap: mean distance between the surfaces of the target and of its three nearest objects, m; at most 0.2 m
            each.
        removals: smallest number of removals (moves of an object) after which the target can be grasped; None: no
            sequence was found.
        first_removals: slots of the objects with which such a sequence can start.
        scripted_removal: slot of the object in the cheapest of the first feasible moves of the scripted policy of
            search (`choose_scripted_removal`); None if no object has to be removed.
        simulated_removals: number of removals that the search has simulated.
        complete: whether the search has tried every sequence of its rules up to ``removals``, or up to
            ``max_removals`` if none was found.
    """

    seed: Annotated[int, Field(ge=0, le=MAX_SEED)]
    target: str
    objects: Count
    visible_fraction: Annotated[float, Field(ge=0, le=1)]
    obstacles: Count
    free_grasps: Count
    fewest_blockers: Count
    gap: Annotated[float, Field(ge=0)]
    removals: Count | None
    first_removals: list[Count]
    scripted_removal: Count | None
    simulated_removals: Count
    complete: bool


@dataclass(frozen=True)
class RemovalLimits:
    """Limits of the search for the smallest number of removals.

    Attributes:
        max_removals: largest number of removals to search.
        max_simulated: number of simulated removals after which no other sequence is started.
        grasp_attempts: number of attempts with different random numbers, of which one must grasp the target.
    """

    max_removals: int = 3
    max_simulated: int = 40
    grasp_attempts: int = 3
