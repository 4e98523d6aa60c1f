"""Status of a plan, read from its folder: on any machine, while others work there."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from robocas_ms3.plans.folder import REPORT, Outcome, read_plan
from robocas_ms3.plans.progress import Progress

_RECENT = 600.0  # s before the last episode that the rate is measured over


@dataclass(frozen=True)
class PartStatus:
    """Status of a part."""

    name: str
    requested: int  # episodes that the plan asks for
    done: int  # episodes that are done, at most `requested`
    tried: int  # seeds
    failed: dict[str, int]  # "stage: reason" -> number of seeds whose last attempt failed for it
    record_seconds: float  # CPU time per episode
    render_seconds: float
    bytes: int  # of the files of the episodes that are done


@dataclass(frozen=True)
class Status:
    """Status of a plan; the content of ``robocas plan status --json``."""

    parts: list[PartStatus]
    episodes_per_hour: float  # in the ten minutes before the last episode
    seconds_left: float | None  # until all are done, if they take the CPU time of others of their part; None: unknown
    idle_seconds: float | None  # since the last episode; None: there is none
    finished: bool  # whether everything is joined


def read_status(out: Path) -> Status:
    """Read the status of the plan in a folder; raise PlanError if there is none."""
    return status_of(Progress(read_plan(out)), finished=(out / REPORT).is_file())


def status_of(progress: Progress, *, finished: bool = False) -> Status:
    """Return the status of a plan from the outcomes of its seeds."""
    outcomes: list[list[Outcome]] = [[] for _ in progress.plan.parts]
    for unit, found in [*progress.done.items(), *progress.partial.items()]:
        outcomes[unit.part] += found
    parts = [
        _part_status(part.name or "", part.episodes, found)
        for part, found in zip(progress.plan.parts, outcomes, strict=True)
    ]
    latest = time.time() + _RECENT  # a clock far ahead would hide all other episodes
    ends = sorted(
        (outcome.end_time, part)
        for part, found in enumerate(outcomes)
        for outcome in found
        if outcome.success and outcome.end_time <= latest
    )
    recent = [(at, part) for at, part in ends if at > ends[-1][0] - _RECENT]
    seconds = recent[-1][0] - recent[0][0] if recent else 0.0
    left = seconds_left(parts, [part for _, part in recent[1:]], seconds) if seconds else None
    return Status(
        parts,
        episodes_per_hour=round(3600 * (len(recent) - 1) / seconds, 1) if seconds else 0.0,
        seconds_left=None if left is None else round(left, 1),
        idle_seconds=round(max(0.0, time.time() - ends[-1][0]), 1) if ends else None,
        finished=finished,
    )


def _part_status(name: str, requested: int, outcomes: Sequence[Outcome]) -> PartStatus:
    good = [outcome for outcome in outcomes if outcome.success]
    done, count = min(requested, len(good)), max(1, len(good))
    return PartStatus(
        name,
        requested,
        done,
        tried=len(outcomes),
        failed=dict(Counter(each.failures[-1] for each in outcomes if not each.success and each.failures)),
        record_seconds=round(sum(each.record_seconds for each in outcomes) / count, 2),
        render_seconds=round(sum(each.render_seconds for each in outcomes) / count, 2),
        bytes=round(sum(each.size for each in good) * done / count),
    )


def seconds_left(parts: Sequence[PartStatus], recent: Sequence[int], seconds: float) -> float:
    """Estimate the time until all episodes are done.

    Args:
        parts: status of each part: an episode takes the mean CPU time of its part, or of all where it has none.
        recent: parts of the recent episodes, at least one.
        seconds: that these took.
    """
    spent = [(part.record_seconds + part.render_seconds) * part.done for part in parts]
    mean = sum(spent) / max(1, sum(part.done for part in parts)) or 1.0  # 1.0: no CPU times are known
    cost = [each / part.done if each else mean for each, part in zip(spent, parts, strict=True)]
    left = sum(each * (part.requested - part.done) for each, part in zip(cost, parts, strict=True))
    return left * seconds / sum(cost[part] for part in recent)
