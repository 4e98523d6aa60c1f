"""Status of a plan, read from its folder, on any machine and while it runs."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from robocas_ms3.plans.folder import REPORT, Outcome, read_plan
from robocas_ms3.plans.progress import PlanProgress

_RATE_WINDOW = 600.0  # s before the last episode, over which the rate is measured


@dataclass(frozen=True)
class PartStatus:
    """Status of a plan part."""

    name: str
    requested: int  # `episodes` of the plan part
    done: int  # number of complete episodes, at most `requested`
    tried: int  # number of seeds that have an outcome
    failed: dict[str, int]  # "stage: reason" of the last attempt -> number of skipped seeds
    record_seconds: float  # CPU time of recording per recorded episode, including skipped seeds
    render_seconds: float  # CPU time of rendering per recorded episode, including skipped seeds
    bytes: int  # size of the complete episodes


@dataclass(frozen=True)
class PlanStatus:
    """Status of a plan; the content of ``robocas plan status --json``."""

    parts: list[PartStatus]
    episodes_per_hour: float  # in the ten minutes before the last episode
    seconds_left: float | None  # estimated from the CPU time per episode of each plan part; None: unknown
    idle_seconds: float | None  # since the last episode; None: no episode yet
    finished: bool  # whether all episodes are joined


def read_status(out: Path) -> PlanStatus:
    """Return the status of the plan in an output folder; raise PlanError if the folder has no plan."""
    return compute_status(PlanProgress(read_plan(out)), finished=(out / REPORT).is_file())


def compute_status(progress: PlanProgress, *, finished: bool = False) -> PlanStatus:
    """Compute the status of a plan from the outcomes of its seeds.

    Args:
        progress: outcomes of the work units.
        finished: whether all episodes are joined.
    """
    outcomes: list[list[Outcome]] = [[] for _ in progress.plan.parts]
    for unit, found in [*progress.done.items(), *progress.partial.items()]:
        outcomes[unit.part] += found
    parts = [
        _part_status(part.name or "", part.episodes, found)
        for part, found in zip(progress.plan.parts, outcomes, strict=True)
    ]
    latest = time.time() + _RATE_WINDOW  # ignore machines whose clock is far ahead
    ends = sorted(
        (outcome.end_time, part)
        for part, found in enumerate(outcomes)
        for outcome in found
        if outcome.success and outcome.end_time <= latest
    )
    recent = [(at, part) for at, part in ends if at > ends[-1][0] - _RATE_WINDOW]
    seconds = recent[-1][0] - recent[0][0] if recent else 0.0
    left = estimate_seconds_left(parts, [part for _, part in recent[1:]], seconds) if seconds else None
    return PlanStatus(
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


def estimate_seconds_left(parts: Sequence[PartStatus], recent: Sequence[int], seconds: float) -> float:
    """Estimate the wall-clock time in s until all episodes are done.

    The estimate scales the wall-clock time of recent episodes by CPU times. An episode takes the mean CPU time of its
    plan part, or of all plan parts if its plan part has no episode yet.

    Args:
        parts: status of each plan part.
        recent: index of the plan part of each recent episode, at least one.
        seconds: wall-clock time of the recent episodes.
    """
    spent = [(part.record_seconds + part.render_seconds) * part.done for part in parts]
    mean = sum(spent) / max(1, sum(part.done for part in parts)) or 1.0  # 1.0: no CPU time is known
    cost = [total / part.done if total else mean for total, part in zip(spent, parts, strict=True)]
    left = sum(cpu * (part.requested - part.done) for cpu, part in zip(cost, parts, strict=True))
    return left * seconds / sum(cost[part] for part in recent)
