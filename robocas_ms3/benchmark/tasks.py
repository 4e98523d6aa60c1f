"""The tasks: a row each, and those of other packages (entry points ``robocas_ms3.tasks``)."""

from __future__ import annotations

from robocas_ms3.benchmark.spec import TaskSpec
from robocas_ms3.extensions import Table

HAS_BASKET = "robocas_ms3.config.checks:has_basket"

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
    checks=(HAS_BASKET,),
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
    summary="grasp the one of several identical objects that the instruction names by where it stands",
    slots=("relation",),
    checks=(HAS_BASKET, "robocas_ms3.config.checks:has_copies"),
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
    summary="find the named object in a heap, clear what covers it, and drop it into the basket",
    checks=(HAS_BASKET,),
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
    checks=(HAS_BASKET,),
)
TASKS = Table("task", "robocas_ms3.tasks", TaskSpec, {spec.name: spec for spec in (PICK, SELECT, SEARCH, OPEN_PICK)})
