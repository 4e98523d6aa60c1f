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
        solver: import path of the scripted policy, ``module:Class``.
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
    solver="robocas_ms3.planning.solvers.pick:PickSolver",
    max_episode_steps=800,
    summary="grasp the named object among scattered ones and drop it into the basket",
)

TASKS: dict[str, TaskSpec] = {spec.name: spec for spec in (PICK,)}
