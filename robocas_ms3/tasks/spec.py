"""The tasks of the benchmark: one frozen spec each, read by the registry, the command line and the tests."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class TaskSpec:
    """A task.

    Attributes:
        name: short name, as in ``robocas generate pick``.
        env_id: gymnasium id.
        default_config: task configuration used when none is given.
        solver: import path of the scripted policy, a module with ``attempt(arm)``.
        max_episode_steps: horizon at 20 Hz; upstream allows 200 steps of 5 Hz.
        summary: one line for people.
    """

    name: str
    env_id: str
    default_config: str
    solver: str
    max_episode_steps: int
    summary: str


PICK = TaskSpec(
    name="pick",
    env_id="RoboCASPick-v1",
    default_config="pick_table_scattered",
    solver="robocas_ms3.planning.solvers.pick",
    max_episode_steps=800,
    summary="grasp the named object among scattered ones and drop it into the basket",
)

SELECT = TaskSpec(
    name="select",
    env_id="RoboCASSelect-v1",
    default_config="select_table_orderly",
    solver="robocas_ms3.planning.solvers.pick",
    max_episode_steps=800,
    summary="grasp the one of several identical objects that the instruction names by where it stands",
)
SEARCH = TaskSpec(
    name="search",
    env_id="RoboCASSearch-v1",
    default_config="search_table_stacked",
    solver="robocas_ms3.planning.solvers.search",
    max_episode_steps=2400,
    summary="find the named object in a heap, clear what covers it, and drop it into the basket",
)
OPEN_PICK = TaskSpec(
    name="open_pick",
    env_id="RoboCASOpenPick-v1",
    default_config="open_pick_container",
    solver="robocas_ms3.planning.solvers.open_pick",
    max_episode_steps=2000,
    summary="open a door or drawer, take the named object out and drop it into the basket",
)

TASKS: dict[str, TaskSpec] = {spec.name: spec for spec in (PICK, SELECT, SEARCH, OPEN_PICK)}
