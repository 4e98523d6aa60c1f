"""Results of seeds, and ``failures.jsonl``: one line per failed attempt, and one per seed that was given up."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from pydantic import Field

from robocas_ms3.core import ledger
from robocas_ms3.core.errors import PlanningFailed
from robocas_ms3.demos.recordings.entries import GREATEST_SEED
from robocas_ms3.planning.seconds import Seconds

FAILURES_FILE = "failures.jsonl"
NOISY = "noisy_"  # begins the reasons of attempts that failed for noise alone


@dataclass(frozen=True)
class Failure:
    """A failed attempt.

    Attributes:
        seed: of the episode.
        attempt: counted from 0; -1 marks the seed as given up.
        stage: of the policy that failed.
        reason: why, in words that can be counted.
        seconds: wall-clock time of the attempt; 0 if a kill came before it was noted.
    """

    seed: Annotated[int, Field(ge=0, le=GREATEST_SEED)]
    attempt: Annotated[int, Field(ge=-1, le=10**6)]
    stage: str
    reason: str
    seconds: Annotated[float, Field(ge=0, le=1e9)]

    @property
    def gave_up(self) -> bool:
        """Whether this line says that the seed has no episode."""
        return self.attempt < 0


@dataclass
class EpisodeResult:
    """Result of a seed; forked processes send theirs back.

    Attributes:
        seed: of the episode.
        success: whether an episode was recorded.
        steps: its length in control steps.
        attempts: attempts used.
        seconds: where the time went.
        failures: every attempt that failed.
        max_attempts: after so many the seed is given up.
        begun: start of the attempt, s of the clock.
    """

    seed: int
    success: bool
    steps: int = 0
    attempts: int = 0
    seconds: Seconds = field(default_factory=Seconds)
    failures: list[Failure] = field(default_factory=list)
    max_attempts: int = 1
    begun: float = field(default_factory=time.perf_counter)

    @property
    def noisy_failures(self) -> int:
        """Number of attempts that failed for noise alone."""
        return sum(failure.reason.startswith(NOISY) for failure in self.failures)

    @property
    def exhausted(self) -> bool:
        """Whether the seed is given up."""
        return len(self.failures) >= self.max_attempts

    def failed(self, error: PlanningFailed) -> None:
        """Note a failed attempt."""
        now = time.perf_counter()
        seconds = round(now - self.begun, 3)
        self.failures.append(Failure(self.seed, len(self.failures), error.stage, error.reason, seconds))
        self.begun = now

    def adopt(self, other: EpisodeResult) -> None:
        """Take over the values that another process sent."""
        vars(self.seconds).update(vars(other.seconds))  # the executor keeps counting in this object
        vars(self).update({key: value for key, value in vars(other).items() if key != "seconds"})


class Ledger(ledger.Ledger[Failure]):
    """The file, appended to seed by seed."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, Failure)

    def by_seed(self) -> dict[int, list[Failure]]:
        """Return the lines of each seed in order, the first of duplicates."""
        found: dict[int, dict[int, Failure]] = {}
        for failure in self.read():
            found.setdefault(failure.seed, {}).setdefault(failure.attempt, failure)
        return {seed: list(attempts.values()) for seed, attempts in found.items()}

    def settle(self, failures: list[Failure]) -> None:
        """See that these are the lines, whatever a kill has lost, doubled or left behind."""
        if [line.record for line in self.lines()] != failures:
            self.rewrite(failures)


def failed_attempts(seed: int, said: Iterable[str], noted: Iterable[Failure]) -> list[Failure]:
    """Return the failed attempts of a recorded seed.

    Args:
        seed: of the episode.
        said: ``stage: reason`` of each attempt in the record.
        noted: lines of the seed in the file, as far as they are complete.
    """
    there = {failure.attempt: failure for failure in noted}
    failures = []
    for attempt, text in enumerate(said):
        stage, _, reason = text.partition(": ")
        known = there.get(attempt)
        same = known is not None and (known.stage, known.reason) == (stage, reason)
        failures.append(known if known and same else Failure(seed, attempt, stage, reason, 0.0))
    return failures


def count_by_stage(failures: Iterable[Failure]) -> dict[str, int]:
    """Return ``{"stage: reason": count}``, most frequent first."""
    return dict(Counter(f"{f.stage}: {f.reason}" for f in failures if not f.gave_up).most_common())
