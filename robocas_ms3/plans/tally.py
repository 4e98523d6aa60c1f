"""What came of a part's units that are done, in one file: so `status` reads no ledger of thousands."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from robocas_ms3.core.documents import JSON_LIMIT, DocumentError, read_bytes
from robocas_ms3.core.files import write_json
from robocas_ms3.core.strict import validate_json
from robocas_ms3.plans.units import UNITS, Count, Outcome, Seconds

RECENT = 600.0  # s that a rate is taken over


@dataclass
class Tally:
    """Sums over the seeds of some units.

    Attributes:
        blocks: of the units.
        tried, good: seeds, and those of them with an episode.
        failed: ``stage: reason`` -> how many seeds failed for it in the end.
        record_seconds, render_seconds: CPU time of all, s.
        size: bytes of the files of episodes.
        times: when episodes were done, s since 1970; written of the last `RECENT` before the last one. Without those
            that a machine's clock puts far ahead: they would outlast all others.
    """

    blocks: set[Count] = field(default_factory=set)
    tried: Count = 0
    good: Count = 0
    failed: dict[str, Count] = field(default_factory=dict)
    record_seconds: Seconds = 0.0
    render_seconds: Seconds = 0.0
    size: Count = 0
    times: list[Seconds] = field(default_factory=list)

    @classmethod
    def read(cls, path: Path) -> Tally:
        """What a file says; of none, or a damaged one, nothing."""
        try:
            return validate_json(_FORM, read_bytes(path, JSON_LIMIT))
        except (OSError, DocumentError, ValidationError):
            return cls()

    def write(self, path: Path) -> None:
        """Write it to a file, whole or not at all."""
        last = max(self.times, default=0.0)
        self.times = [at for at in self.times if at > last - RECENT]
        write_json(path, {**asdict(self), "blocks": sorted(self.blocks)})

    def add(self, block: int, found: Iterable[Outcome]) -> None:
        """Count what came of a unit's seeds, or of some of them."""
        self.blocks.add(block)
        until = time.time() + RECENT
        for outcome in found:
            self.tried += 1
            self.record_seconds += outcome.record_seconds
            self.render_seconds += outcome.render_seconds
            if outcome.success:
                self.good += 1
                self.size += outcome.size
                if outcome.at <= until:
                    self.times.append(outcome.at)
            elif outcome.failures:
                self.failed[outcome.failures[-1]] = self.failed.get(outcome.failures[-1], 0) + 1


_FORM: TypeAdapter[Tally] = TypeAdapter(Tally)


def tally_path(out: Path, part: str) -> Path:
    """File of a part's tally, in the plan's folder."""
    return out / UNITS / f"{part}.json"
