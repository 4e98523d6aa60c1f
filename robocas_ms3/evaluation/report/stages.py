"""What the stages of an episode are called on the page."""

from __future__ import annotations

from robocas_ms3.scenes.task_specs import STAGES as ON_THE_WAY
from robocas_ms3.scenes.task_specs import TASKS

STAGES = {
    "furniture_opened": "furniture opened",
    "reached_any": "an object touched (RA)",
    "picked_any": "an object picked (PA)",
    "obstacles_cleared": "obstacles cleared (CO)",
    "reached_target": "target touched (RR)",
    "target_grasped": "target grasped",
    "target_lifted": "target lifted",
    "target_in_basket": "target in basket",
    "success": "success",
}
"""Of the funnels, in the order in which they are usually come to."""
FAILURES = {
    **{stage: said.split(" (")[0] for stage, said in STAGES.items() if stage != "success"},
    "placed": "placed, at rest",
    "error": "broken off",
}
"""What an episode did not come to (`outcomes.failure_stage`)."""


def funnel_of(task: str) -> dict[str, str]:
    """What the stages of a task are called, in their order; those of another package's by their own names."""
    row = TASKS.get(task)
    if row is None or row.stages == ON_THE_WAY:
        return STAGES
    return {stage: STAGES.get(stage, _plain(stage)) for stage in (*row.stages, "success")}


def failure_of(stage: str) -> str:
    """What it is called that an episode did not come to this stage."""
    return FAILURES.get(stage, _plain(stage))


def _plain(stage: str) -> str:
    return stage.replace("_", " ")
