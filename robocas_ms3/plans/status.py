"""How far a plan is, read from its folder alone: by any machine that sees it, while others work there."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from robocas_ms3.plans.begun import read_plan
from robocas_ms3.plans.tally import RECENT, Tally, tally_path
from robocas_ms3.plans.units import REPORT, begun, outcomes


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
        bytes: of pictures and arrays.
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
        seconds_left: until all episodes are there, at that rate; None: not known.
        idle_seconds: since the last episode; None: there is none.
        finished: whether everything is joined.
    """

    parts: list[PartStatus]
    episodes_an_hour: float
    seconds_left: float | None
    idle_seconds: float | None
    finished: bool

    def as_json(self) -> dict[str, Any]:
        """For ``--json``."""
        return asdict(self)


def status(out: Path) -> Status:
    """Read how far a plan is.

    Raises:
        PlanError: no plan was begun there.
    """
    plan = read_plan(out)
    parts, times = [], []
    for number, part in enumerate(plan.parts):
        tally = Tally.read(tally_path(out, f"{part.name}"))
        for unit in begun(plan, out, number):  # those under way, and those that were done just now
            if unit.block not in tally.blocks:
                tally.add(unit.block, outcomes(unit.folder(plan, out)).values())
        times += tally.times
        parts.append(_part(f"{part.name}", part.episodes, tally))
    rate = _rate(sorted(times))
    left = sum(part.wanted - part.done for part in parts)
    return Status(
        parts,
        round(3600 * rate, 1),
        round(left / rate, 1) if rate else None,
        round(max(0.0, time.time() - max(times)), 1) if times else None,
        (out / REPORT).is_file(),
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
        tally.size,
    )


def _rate(times: list[float]) -> float:
    """Episodes a second, by when they were done; 0 where that is not known."""
    recent = [at for at in times if at > times[-1] - RECENT]
    return (len(recent) - 1) / (recent[-1] - recent[0]) if len(recent) > 1 and recent[-1] > recent[0] else 0.0
