"""Specifications of the tasks. Other packages add tasks by entry points ``robocas_ms3.tasks``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from robocas_ms3.core.extensions import Registry

SIM_FREQ = 100  # Hz, physics
STANDARD_FREQ = 20  # Hz, control; the horizon registered with gymnasium assumes this rate
STAGES = ("furniture_opened", "reached_any", "obstacles_cleared", "reached_target", "target_grasped", "target_lifted")
MAX_HIDDEN_FRACTION = 0.2  # greatest hidden fraction of a cleared target (paper)
MAX_OBSTACLES = 1  # greatest number of obstacles around a cleared target (paper)


@dataclass(frozen=True)
class TaskSpec:
    """Specification of a task.

    Code is named by import path ``package.module:name``, so no simulator is imported.

    Attributes:
        name: name of the task in commands, such as ``robocas generate pick``.
        env_id: gymnasium id.
        env: import path of the environment class, a subclass of `tasks.base.RoboCASEnv` whose ``SPEC`` is this object.
        default_config: name of a bundled task configuration, or path of a YAML file.
        target: import path of a `scenes.targets.TargetRule`.
        solver: import path of the scripted policy, a function that makes one attempt with an `Arm`.
        seconds: horizon in s. RoboCAS-v0 allows 200 steps at 5 Hz, which is 40 s.
        training_seconds: horizon in s for training with a fixed base (`rl_kwargs`).
        summary: one line for `robocas list`.
        slots: slots of the instructions in addition to object and support: ``relation``, which an instruction may leave
            empty, and ``part``.
        checks: import paths of functions that raise ValueError if a `TaskConfig` does not suit the task.
        instructions: instruction templates by split; default: those of ``language/instructions.yaml``.
        stages: stages of an episode, in order. An evaluation reports the first stage not reached.
        check_failures: default of ``robocas generate --check-failures``.
    """

    name: str
    env_id: str
    env: str
    default_config: str
    target: str
    solver: str
    seconds: int
    training_seconds: int
    summary: str
    slots: tuple[str, ...] = ()
    checks: tuple[str, ...] = ()
    instructions: Mapping[str, Sequence[str]] = field(default_factory=dict, hash=False)
    stages: tuple[str, ...] = STAGES
    check_failures: int = 1

    def horizon_steps(self, control_freq: int) -> int:
        """Return the horizon in control steps; ``control_freq`` is the control rate in Hz."""
        return self.seconds * control_freq

    @property
    def max_episode_steps(self) -> int:
        """Horizon in control steps at `STANDARD_FREQ`, as registered with gymnasium."""
        return self.horizon_steps(STANDARD_FREQ)


REQUIRE_BASKET = "robocas_ms3.scenes.config.task:require_basket"

PICK = TaskSpec(
    name="pick",
    env_id="RoboCASPick-v1",
    env="robocas_ms3.tasks.pick:RoboCASPickEnv",
    default_config="pick_table_scattered",
    target="robocas_ms3.scenes.targets:BY_NAME",
    solver="robocas_ms3.planning.solvers.pick:attempt",
    seconds=40,
    training_seconds=20,
    summary="grasp the named object among scattered ones and drop it into the basket",
    checks=(REQUIRE_BASKET,),
)
SELECT = TaskSpec(
    name="select",
    env_id="RoboCASSelect-v1",
    env="robocas_ms3.tasks.select:RoboCASSelectEnv",
    default_config="select_table_orderly",
    target="robocas_ms3.scenes.targets:BY_RELATION",
    solver="robocas_ms3.planning.solvers.pick:attempt",
    seconds=40,
    training_seconds=20,
    summary="grasp one of several identical objects, named by its position, and drop it into the basket",
    slots=("relation",),
    checks=(REQUIRE_BASKET, "robocas_ms3.scenes.config.task:require_copies"),
)
SEARCH = TaskSpec(
    name="search",
    env_id="RoboCASSearch-v1",
    env="robocas_ms3.tasks.search:RoboCASSearchEnv",
    default_config="search_table_stacked",
    target="robocas_ms3.scenes.targets:BY_VISIBILITY",
    solver="robocas_ms3.planning.solvers.search:attempt",
    seconds=120,
    training_seconds=90,
    summary="find the named object in a heap, remove the objects that cover it, and drop it into the basket",
    checks=(REQUIRE_BASKET,),
    check_failures=0,  # half of all searches fail with noise, and an attempt at search takes long
)
OPEN_PICK = TaskSpec(
    name="open_pick",
    env_id="RoboCASOpenPick-v1",
    env="robocas_ms3.tasks.open_pick:RoboCASOpenPickEnv",
    default_config="open_pick_container",
    target="robocas_ms3.scenes.targets:BY_NAME",
    solver="robocas_ms3.planning.solvers.open_pick:attempt",
    seconds=100,
    training_seconds=40,
    summary="open a door or drawer, take the named object out and drop it into the basket",
    slots=("part",),
    checks=(REQUIRE_BASKET,),
)
TASKS = Registry("task", "robocas_ms3.tasks", TaskSpec, {spec.name: spec for spec in (PICK, SELECT, SEARCH, OPEN_PICK)})
