"""Units of work: blocks of a part's seeds, and what the folder says of them.

``OUT/units/PART/BLOCK`` belongs to one unit, which nobody else writes into: its ledger has a line a seed, and its
other files are episodes that wait to be joined. A unit that is done says so in ``done.json``.
"""

from __future__ import annotations

import shutil
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from pydantic import Field

from robocas_ms3.core.ledger import Ledger
from robocas_ms3.datasets.schema import episode_folder
from robocas_ms3.demos.recordings.seeds import GREATEST_SEED
from robocas_ms3.plans.plan import Plan

PLAN, REPORT = "plan.json", "report.json"
UNITS, LEDGER, DEATHS, DONE = "units", "seeds.jsonl", "deaths.jsonl", "done.json"
CLAIMS = Path("slurm", "claims")
"""Folder in the plan's, of the claims that jobs of Slurm have on units."""
DRIVER = ".driver"
"""Claim in the plan's folder, of who runs it."""
EPISODES = "episodes"
"""Folder of a unit with its rendered episodes."""


Seed = Annotated[int, Field(ge=0, le=GREATEST_SEED)]
Count = Annotated[int, Field(ge=0, le=10**15)]
Seconds = Annotated[float, Field(ge=0, le=1e12)]


@dataclass(frozen=True, order=True)
class Unit:
    """A block of a part's seeds."""

    part: int
    block: int

    def seeds(self, plan: Plan) -> range:
        """The seeds."""
        size = plan.block_of(self.part)
        first = plan.parts[self.part].seed + self.block * size
        return range(first, first + size)

    def is_done(self, plan: Plan, out: Path) -> bool:
        """Whether all its seeds are; a line of the ledger that was damaged since is done again."""
        folder = self.folder(plan, out)
        return (folder / DONE).is_file() and outcomes(folder).keys() >= set(self.seeds(plan))

    def result(self, plan: Plan, out: Path) -> list[Outcome]:
        """What came of it, when it is done; in the order of the seeds."""
        found = outcomes(self.folder(plan, out))
        return [found[seed] for seed in self.seeds(plan)]

    def folder(self, plan: Plan, out: Path) -> Path:
        """Where its files lie."""
        return out / UNITS / f"{plan.parts[self.part].name}" / f"{self.block:05d}"

    def forget(self, plan: Plan, out: Path, seeds: Collection[int]) -> None:
        """Forget what came of some seeds, which are then done again; nobody may be at the unit."""
        folder = self.folder(plan, out)
        (folder / DONE).unlink(missing_ok=True)
        lines = ledger(folder)
        lines.rewrite(outcome for outcome in lines.read() if outcome.seed not in seeds)


@dataclass(frozen=True)
class Task:
    """A seed of a part, and the folder of its unit."""

    part: int
    seed: int
    folder: Path

    @property
    def layout(self) -> Path:
        """Its layout."""
        return self.folder / f"seed_{self.seed:010d}.npy"

    @property
    def recording(self) -> Path:
        """Its recorded episode."""
        return self.folder / f"seed_{self.seed:010d}.h5"

    @property
    def episode(self) -> Path:
        """Its rendered episode."""
        return self.folder / EPISODES / f"{self.seed:010d}" / episode_folder(0)

    def size(self) -> int:
        """Bytes of all its files."""
        files = [*self.folder.glob(f"seed_{self.seed:010d}.*"), *self.episode.rglob("*")]
        return sum(path.stat().st_size for path in files if path.is_file())

    def clear(self) -> None:
        """Delete its files: of a seed without a line in the ledger they may not be whole, after a power cut."""
        for path in self.folder.glob(f"seed_{self.seed:010d}.*"):
            path.unlink()
        shutil.rmtree(self.episode.parent, ignore_errors=True)


@dataclass(frozen=True)
class Outcome:
    """What came of a seed.

    Attributes:
        seed: it.
        success: whether there is an episode.
        steps: its length in control steps.
        failures: ``stage: reason`` of each attempt that failed.
        record_seconds, render_seconds: CPU time, of the processes that did it.
        size: bytes of its files.
        at: when it was done, s since 1970, of the machine that did it.
    """

    seed: Seed
    success: bool
    steps: Count = 0
    failures: list[str] = field(default_factory=list)
    record_seconds: Seconds = 0.0
    render_seconds: Seconds = 0.0
    size: Count = 0
    at: Seconds = 0.0


@dataclass(frozen=True)
class Death:
    """A process that ended at a seed, and why."""

    seed: Seed
    stage: str
    why: str


def ledger(folder: Path) -> Ledger[Outcome]:
    """The unit's."""
    return Ledger(folder / LEDGER, Outcome)


def deaths(folder: Path) -> Ledger[Death]:
    """The unit's."""
    return Ledger(folder / DEATHS, Death)


def outcomes(folder: Path) -> dict[int, Outcome]:
    """Seed -> what came of it, as far as the unit got; of a line written twice the first counts."""
    found: dict[int, Outcome] = {}
    for outcome in ledger(folder).read():
        found.setdefault(outcome.seed, outcome)
    return found


def begun(plan: Plan, out: Path, part: int) -> Iterator[Unit]:
    """Units of a part that have a folder, in order."""
    folder = out / UNITS / f"{plan.parts[part].name}"
    for path in sorted(folder.glob("[0-9]*")):
        if path.name.isdecimal():
            yield Unit(part, int(path.name))
