"""How far a plan is, read from its folder alone: by any machine that sees it, while others work there."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from robocas_ms3.plans.begun import read_plan
from robocas_ms3.plans.driver import who_runs
from robocas_ms3.plans.tally import RECENT, Tally, tally_path
from robocas_ms3.plans.units import DRIVER, REPORT, begun, outcomes


@dataclass(frozen=True)
class PartStatus:
    """A part of the plan.

    Attributes:
        name: of its folders.
        wanted: episodes asked for.
        done: episodes there are, those beyond what was asked for left out.
        tried: seeds.
        failed: ``stage: reason`` -> how many seeds failed for it in the end.
        record_seconds, render_seconds: CPU time an episode, s.
        bytes: of the files of those that are done.
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
    """The plan.

    Attributes:
        parts: of it.
        episodes_an_hour: of the last ten minutes before the last episode.
        seconds_left: until all episodes are there, if they take the CPU time that those of their part took; None: not
            known.
        idle_seconds: since the last episode; None: there is none.
        finished: whether everything is joined.
        at_work: the machine that runs the plan now; None: nobody does.
    """

    parts: list[PartStatus]
    episodes_an_hour: float
    seconds_left: float | None
    idle_seconds: float | None
    finished: bool
    at_work: str | None = None

    def as_json(self) -> dict[str, Any]:
        """For ``--json``."""
        return asdict(self)


def status(out: Path) -> Status:
    """Read how far a plan is.

    Raises:
        PlanError: no plan was begun there.
    """
    plan = read_plan(out)
    parts: list[PartStatus] = []
    times: list[tuple[float, int]] = []  # when an episode was done, of which part
    for number, part in enumerate(plan.parts):
        tally = Tally.read(tally_path(out, f"{part.name}"))
        for unit in begun(plan, out, number):  # those under way, and those that were done just now
            if unit.block not in tally.blocks:
                tally.add(unit.block, outcomes(unit.folder(plan, out)).values())
        times += [(at, number) for at in tally.times]
        parts.append(_part(f"{part.name}", part.episodes, tally))
    lately, seconds = _lately(sorted(times))
    left = _seconds_left(parts, lately, seconds)
    return Status(
        parts,
        round(3600 * len(lately) / seconds, 1) if seconds else 0.0,
        None if left is None else round(left, 1),
        round(max(0.0, time.time() - max(times)[0]), 1) if times else None,
        (out / REPORT).is_file(),
        who_runs(out / DRIVER),
    )


def _part(name: str, wanted: int, tally: Tally) -> PartStatus:
    each = max(1, tally.good)
    return PartStatus(
        name,
        wanted,
        min(wanted, tally.good),
        tally.tried,
        tally.failed,
        round(tally.record_seconds / each, 2),
        round(tally.render_seconds / each, 2),
        round(tally.size * min(wanted, tally.good) / each),
    )


def _lately(times: list[tuple[float, int]]) -> tuple[list[int], float]:
    """Parts of the episodes that were done of late, and the seconds they took; 0 s where that is not known."""
    recent = [(at, part) for at, part in times if at > times[-1][0] - RECENT]
    if len(recent) < 2 or recent[-1][0] <= recent[0][0]:
        return [], 0.0
    return [part for _, part in recent[1:]], recent[-1][0] - recent[0][0]


def _seconds_left(parts: Sequence[PartStatus], lately: Sequence[int], seconds: float) -> float | None:
    """Time until all is done: what is left costs what episodes of its part cost, or those of all where it has none."""
    if not lately:
        return None
    done = sum(part.done for part in parts)
    spent = [(part.record_seconds + part.render_seconds) * part.done for part in parts]
    mean = sum(spent) / max(1, done)
    cost = [each / part.done if part.done else mean for each, part in zip(spent, parts, strict=True)]
    if not mean:  # nothing says what they cost
        cost = [1.0] * len(parts)
    left = sum(each * (part.wanted - part.done) for each, part in zip(cost, parts, strict=True))
    return left * seconds / max(1e-9, sum(cost[part] for part in lately))
