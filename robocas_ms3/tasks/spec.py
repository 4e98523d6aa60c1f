"""The tasks of the benchmark: one frozen spec each, read by the registry, the command line and the tests."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from robocas_ms3.config import TaskConfig, load_task_config
from robocas_ms3.errors import ConfigError


@dataclass(frozen=True)
class TaskSpec:
    """A task.

    Attributes:
        name: short name, as in ``robocas generate pick``.
        env_id: gymnasium id.
        default_config: task configuration used when none is given.
        solver: import path of the scripted policy, a module with ``attempt(arm)``.
        max_episode_steps: horizon at 20 Hz; upstream allows 200 steps of 5 Hz.
        training_steps: horizon at 5 Hz to train with where the base stands still (`rl_kwargs`).
        summary: one line for people.
    """

    name: str
    env_id: str
    default_config: str
    solver: str
    max_episode_steps: int
    training_steps: int
    summary: str

    def load_config(self, config: str | Path | dict | TaskConfig | None = None) -> TaskConfig:
        """Read a configuration of the task.

        Args:
            config: see `load_task_config`; None: the default.

        Raises:
            ConfigError: it is wrong, or another task's.
        """
        loaded = load_task_config(self.default_config if config is None else config)
        if loaded.task != self.name:
            name = f" {config}" if isinstance(config, str) else ""
            raise ConfigError(
                f"{self.env_id} can't run the configuration{name}",
                expected=f"task: {self.name}",
                found=f"task: {loaded.task}",
            )
        return loaded


PICK = TaskSpec(
    name="pick",
    env_id="RoboCASPick-v1",
    default_config="pick_table_scattered",
    solver="robocas_ms3.planning.solvers.pick",
    max_episode_steps=800,
    training_steps=100,
    summary="grasp the named object among scattered ones and drop it into the basket",
)

SELECT = TaskSpec(
    name="select",
    env_id="RoboCASSelect-v1",
    default_config="select_table_orderly",
    solver="robocas_ms3.planning.solvers.pick",
    max_episode_steps=800,
    training_steps=100,
    summary="grasp the one of several identical objects that the instruction names by where it stands",
)
SEARCH = TaskSpec(
    name="search",
    env_id="RoboCASSearch-v1",
    default_config="search_table_stacked",
    solver="robocas_ms3.planning.solvers.search",
    max_episode_steps=2400,
    training_steps=450,
    summary="find the named object in a heap, clear what covers it, and drop it into the basket",
)
OPEN_PICK = TaskSpec(
    name="open_pick",
    env_id="RoboCASOpenPick-v1",
    default_config="open_pick_container",
    solver="robocas_ms3.planning.solvers.open_pick",
    max_episode_steps=2000,
    training_steps=200,
    summary="open a door or drawer, take the named object out and drop it into the basket",
)

TASKS: dict[str, TaskSpec] = {spec.name: spec for spec in (PICK, SELECT, SEARCH, OPEN_PICK)}
