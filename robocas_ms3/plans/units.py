"""Work units: blocks of a part's seeds, and their files.

`OUT/units/PART/BLOCK/SEED/` has the episode of a seed and `outcome.json`. Its files are written into a temporary
folder, which is renamed when they are complete. So a unit may be done twice, even at the same time: the first folder of
a seed is kept, and another one has the same content. `seeds.jsonl` has the outcomes of a complete unit, a line each.
"""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from pydantic import Field, TypeAdapter, ValidationError

from robocas_ms3.core.documents import JSON_LIMIT, DocumentError, read_bytes
from robocas_ms3.core.files import flush_to_disk, make_folder
from robocas_ms3.core.ledger import Ledger
from robocas_ms3.core.strict import validate_json
from robocas_ms3.datasets.schema import episode_folder
from robocas_ms3.demos.recordings.entries import GREATEST_SEED
from robocas_ms3.plans.folder import UNITS
from robocas_ms3.plans.plan import Plan

OUTCOME, OUTCOMES = "outcome.json", "seeds.jsonl"
Count = Annotated[int, Field(ge=0, le=10**15)]
Seconds = Annotated[float, Field(ge=0, le=1e12)]


@dataclass(frozen=True)
class Outcome:
    """Outcome of a seed.

    Attributes:
        seed: the seed.
        success: whether there is an episode.
        steps: its length in control steps.
        failures: ``stage: reason`` of each attempt that failed.
        deaths: ``stage: reason`` of each process that died, or was killed for a limit, at this seed.
        record_seconds, render_seconds: CPU time, of the processes that made it.
        size: bytes of its files, without ``outcome.json``.
        at: when it was complete, s since 1970, by the clock of the machine that made it.
    """

    seed: Annotated[int, Field(ge=0, le=GREATEST_SEED)]
    success: bool
    steps: Count = 0
    failures: list[str] = field(default_factory=list)
    deaths: list[str] = field(default_factory=list)
    record_seconds: Seconds = 0.0
    render_seconds: Seconds = 0.0
    size: Count = 0
    at: Seconds = 0.0


_OUTCOME: TypeAdapter[Outcome] = TypeAdapter(Outcome)


@dataclass(frozen=True)
class SeedFiles:
    """Files of one seed of a part, in a folder."""

    part: int
    seed: int
    folder: Path

    @property
    def layout(self) -> Path:
        """File of its layout."""
        return self.folder / "layout.npy"

    @property
    def recording(self) -> Path:
        """File of its recorded episode; a JSON file is next to it."""
        return self.folder / "recording.h5"

    @property
    def episode(self) -> Path:
        """Folder of its rendered episode."""
        return self.folder / episode_folder(0)

    def size(self) -> int:
        """Return the bytes of all files but the outcome."""
        return sum(path.stat().st_size for path in self.folder.rglob("*") if path.is_file() and path.name != OUTCOME)

    def outcome(self) -> Outcome | None:
        """Read the outcome; None: the seed is not done, or its file is damaged."""
        with suppress(OSError, DocumentError, ValidationError):
            return validate_json(_OUTCOME, read_bytes(self.folder / OUTCOME, JSON_LIMIT))

    def write(self, outcome: Outcome) -> None:
        """Write the outcome."""
        (self.folder / OUTCOME).write_bytes(_OUTCOME.dump_json(outcome))

    @contextmanager
    def temporary(self) -> Iterator[SeedFiles]:
        """Yield files in a temporary folder; on success it is renamed to this folder, unless that exists already."""
        tmp = make_folder(self.folder.with_name(f".{self.folder.name}.{secrets.token_hex(8)}.tmp"))
        try:
            yield SeedFiles(self.part, self.seed, tmp)
            flush_to_disk(tmp)  # a folder that survives a power cut has complete files
            if self.folder.is_dir() and self.outcome() is None:
                shutil.rmtree(self.folder)  # a disk error has damaged it
            try:
                tmp.rename(self.folder)
            except OSError:
                if self.outcome() is None:
                    raise
        finally:
            shutil.rmtree(tmp, ignore_errors=True)


@dataclass(frozen=True, order=True)
class Unit:
    """A work unit: a block of a part's seeds."""

    part: int
    block: int

    def seeds(self, plan: Plan) -> range:
        """Return its seeds."""
        size = plan.block_of(self.part)
        first = plan.parts[self.part].seed + self.block * size
        return range(first, first + size)

    def folder(self, plan: Plan, out: Path) -> Path:
        """Return its folder."""
        return out / UNITS / plan.name_of(self.part) / f"{self.block:05d}"

    def files(self, plan: Plan, out: Path, seed: int) -> SeedFiles:
        """Return the files of one of its seeds."""
        return SeedFiles(self.part, seed, self.folder(plan, out) / f"{seed:010d}")

    def outcomes(self, plan: Plan, out: Path) -> list[Outcome] | None:
        """Read the outcomes of all its seeds, in order; None: it is not complete."""
        found: dict[int, Outcome] = {}
        with suppress(OSError, DocumentError):
            found = {outcome.seed: outcome for outcome in self._ledger(plan, out).read()}
        seeds = self.seeds(plan)
        return [found[seed] for seed in seeds] if found.keys() >= set(seeds) else None

    def partial_outcomes(self, plan: Plan, out: Path) -> list[Outcome]:
        """Read the outcomes of the seeds that are done of a unit that is not complete."""
        found = (self.files(plan, out, seed).outcome() for seed in self.seeds(plan))
        return [outcome for outcome in found if outcome is not None]

    def complete(self, plan: Plan, out: Path) -> None:
        """Write ``seeds.jsonl``, once all seeds are done."""
        outcomes = self.partial_outcomes(plan, out)
        if len(outcomes) == len(self.seeds(plan)):
            self._ledger(plan, out).rewrite(outcomes)

    def forget(self, plan: Plan, out: Path, seeds: Collection[int]) -> None:
        """Delete some seeds, which are then done again."""
        self._ledger(plan, out).path.unlink(missing_ok=True)
        for seed in seeds:
            shutil.rmtree(self.files(plan, out, seed).folder, ignore_errors=True)

    def _ledger(self, plan: Plan, out: Path) -> Ledger[Outcome]:
        return Ledger(self.folder(plan, out) / OUTCOMES, Outcome)


def started_blocks(plan: Plan, out: Path, part: int) -> list[int]:
    """Return the blocks of a part that have a folder, in order."""
    names: list[str] = []
    with suppress(FileNotFoundError):
        names = os.listdir(out / UNITS / plan.name_of(part))  # asks an NFS server; whether a file exists may not
    return sorted(int(name) for name in names if name.isascii() and name.isdecimal())
