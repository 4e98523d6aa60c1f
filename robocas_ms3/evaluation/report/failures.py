"""The stages of an episode by name, and the failed episodes, for the page."""

from __future__ import annotations

from html import escape
from pathlib import Path

from robocas_ms3.core.words import count_of
from robocas_ms3.evaluation.outcomes import Outcome
from robocas_ms3.evaluation.report.html import section, table
from robocas_ms3.evaluation.results import Result
from robocas_ms3.scenes.task_specs import STAGES as ON_THE_WAY
from robocas_ms3.scenes.task_specs import TASKS

VIDEOS = "videos"
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


def video_name(episode: int) -> str:
    """Of the file in ``videos``."""
    return f"episode_{episode:05d}.mp4"


def failed_episodes(result: Result, folder: Path | None) -> str:
    """A section of the page, empty where none failed; numbers of episodes that have a video lead to it."""
    failed = [outcome for outcome in result.outcomes.values() if not outcome.success]
    if not failed:
        return ""
    filters = "".join(
        f'<label>{said} <select data-column="{column}"><option value="">all</option>'
        f"{_options(values)}</select></label>\n"
        for said, column, values in (
            ("configuration", 1, {outcome.config for outcome in failed}),
            ("split", 3, {outcome.split for outcome in failed}),
            ("not come to", 4, {failure_of(outcome.failure_stage) for outcome in failed}),
        )
    )
    rows = [
        [
            _named(outcome, folder),
            escape(outcome.config),
            str(outcome.seed),
            escape(outcome.split),
            escape(failure_of(outcome.failure_stage)),
            _ended_by(outcome),
            str(outcome.steps),
            f"{outcome.seconds:.1f}",
            "" if outcome.p_vis is None else f"{outcome.p_vis:.2f}",
            f"{outcome.measures.get('disturbed_most', 0):.0f}",
            escape(outcome.error),
        ]
        for outcome in failed
    ]
    heads = (
        *("episode#", "configuration", "seed#", "split", "not come to", "ended by"),
        *("steps#", "s#", "p_vis#", "disturbed#", "error"),
    )
    linked = any("<a " in row[0] for row in rows)
    command = "<code>robocas eval videos RESULT --policy POLICY</code>"
    films = "Numbers that are links lead to videos." if linked else f"{command} films some of them."
    said = (
        f'<span id="count">{len(failed)}</span> of {count_of(len(result.outcomes), "episode")}. '
        "Ended by: the time they had, a failure such as a target on the floor, or an error. " + films
    )
    return section("Failed episodes", said, f'<form class="filters">{filters}</form>\n' + table(heads, rows, "failed"))


def _ended_by(outcome: Outcome) -> str:
    return "error" if outcome.error else "failure" if outcome.flags.get("fail") is not None else "time"


def _named(outcome: Outcome, folder: Path | None) -> str:
    name = f"{VIDEOS}/{video_name(outcome.episode)}"
    linked = folder is not None and (folder / name).is_file()
    return f'<a href="{name}">{outcome.episode}</a>' if linked else str(outcome.episode)


def _options(values: set[str]) -> str:
    return "".join(f"<option>{escape(value)}</option>" for value in sorted(values))


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
