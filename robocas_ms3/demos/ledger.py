"""``failures.jsonl``: one line for every failed attempt, and one for every seed that was given up."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from robocas_ms3 import ledger

FAILURES_FILE = "failures.jsonl"


@dataclass(frozen=True)
class Failure:
    """A failed attempt.

    Attributes:
        seed: of the episode.
        attempt: counted from 0; -1 marks the seed as given up.
        stage: where the policy could not go on.
        reason: why, in words that can be counted.
        seconds: wall-clock time the attempt took.
    """

    seed: int
    attempt: int
    stage: str
    reason: str
    seconds: float

    @property
    def gave_up(self) -> bool:
        """Whether this line says that the seed has no episode."""
        return self.attempt < 0


class Ledger(ledger.Ledger[Failure]):
    """The file, appended to seed by seed."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, Failure)

    def keep_only(self, seeds: set[int]) -> None:
        """Drop the lines of seeds that will be run again."""
        self.rewrite(failure for failure in self.read() if failure.seed in seeds)


def count_by_stage(failures: Iterable[Failure]) -> dict[str, int]:
    """``{"stage: reason": count}``, most frequent first."""
    return dict(Counter(f"{f.stage}: {f.reason}" for f in failures if not f.gave_up).most_common())
