"""Status of a plan, read from its folder: on any machine, while others work there."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from robocas_ms3.plans.folder import REPORT, read_plan
from robocas_ms3.plans.progress import Progress
from robocas_ms3.plans.units import Outcome

_RECENT = 600.0  # s before the last episode that the rate is measured over


@dataclass(frozen=True)
class PartStatus:
    """Status of a part.

    Attributes:
        name: of its folders.
        wanted: episodes that the plan asks for.
        done: episodes that are done, at most ``wanted``.
        tried: seeds.
        failed: ``stage: reason`` -> number of seeds whose last attempt failed for it.
        record_seconds, render_seconds: CPU time per episode, s.
        bytes: of the files of the episodes that are done.
    """

    name: str
    wanted: int
    done: int
    tried: int
    failed: dict[str, int]
    record_seconds: float
    render_seconds: float
    bytes: int


@dataclass(frozen=True)
class Status:
    """Status of a plan.

    Attributes:
        parts: status of each part.
        episodes_an_hour: in the ten minutes before the last episode.
        seconds_left: until all episodes are done, if they take the CPU time of others of their part; None: unknown.
        idle_seconds: since the last episode; None: there is none.
        finished: whether everything is joined.
    """

    parts: list[PartStatus]
    episodes_an_hour: float
    seconds_left: float | None
    idle_seconds: float | None
    finished: bool

    def as_json(self) -> dict[str, Any]:
        """Return the content of ``--json``."""
        return asdict(self)


def read_status(out: Path) -> Status:
    """Read the status of the plan in a folder.

    Raises:
        PlanError: no plan was started there.
    """
    return status_of(Progress(read_plan(out), out), finished=(out / REPORT).is_file())


def status_of(progress: Progress, *, finished: bool = False) -> Status:
    """Return the status of a plan from the outcomes of its seeds."""
    plan, partial = progress.plan, progress.partial()
    parts: list[PartStatus] = []
    times: list[tuple[float, int]] = []  # when an episode was done, and its part
    latest = time.time() + _RECENT  # a clock far ahead would hide all other episodes
    for number, part in enumerate(progress.parts):
        outcomes = [*(outcome for unit in part.done.values() for outcome in unit), *partial[number]]
        parts.append(_part(plan.name_of(number), plan.parts[number].episodes, outcomes))
        times += [(outcome.at, number) for outcome in outcomes if outcome.success and outcome.at <= latest]
    recent, seconds = _recent(sorted(times))
    left = seconds_left(parts, recent, seconds)
    return Status(
        parts,
        round(3600 * len(recent) / seconds, 1) if seconds else 0.0,
        None if left is None else round(left, 1),
        round(max(0.0, time.time() - max(times)[0]), 1) if times else None,
        finished,
    )


def _part(name: str, wanted: int, outcomes: Sequence[Outcome]) -> PartStatus:
    good = [outcome for outcome in outcomes if outcome.success]
    failed = Counter(each.failures[-1] for each in outcomes if not each.success and each.failures)
    done, count = min(wanted, len(good)), max(1, len(good))
    return PartStatus(
        name,
        wanted,
        done,
        len(outcomes),
        dict(failed),
        round(sum(each.record_seconds for each in outcomes) / count, 2),
        round(sum(each.render_seconds for each in outcomes) / count, 2),
        round(sum(each.size for each in good) * done / count),
    )


def _recent(times: list[tuple[float, int]]) -> tuple[list[int], float]:
    """Return the parts of recent episodes and the seconds that they took; 0 s where that is unknown."""
    recent = [(at, part) for at, part in times if at > times[-1][0] - _RECENT]
    if len(recent) < 2 or recent[-1][0] <= recent[0][0]:
        return [], 0.0
    return [part for _, part in recent[1:]], recent[-1][0] - recent[0][0]


def seconds_left(parts: Sequence[PartStatus], recent: Sequence[int], seconds: float) -> float | None:
    """Estimate the time until all episodes are done; None: unknown.

    Args:
        parts: status of each part: an episode takes the mean CPU time of its part, or of all where it has none.
        recent: parts of the recent episodes.
        seconds: that these took.
    """
    if not recent:
        return None
    done = sum(part.done for part in parts)
    spent = [(part.record_seconds + part.render_seconds) * part.done for part in parts]
    mean = sum(spent) / max(1, done)
    cost = [each / part.done if part.done else mean for each, part in zip(spent, parts, strict=True)]
    if not mean:  # no CPU times are known
        cost = [1.0] * len(parts)
    left = sum(each * (part.wanted - part.done) for each, part in zip(cost, parts, strict=True))
    return left * seconds / max(1e-9, sum(cost[part] for part in recent))
