"""``failures.jsonl``: one line for every failed attempt, and one for every seed that was given up."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

from robocas_ms3.files import replacing


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


class Ledger:
    """The file, appended to seed by seed."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def read(self) -> list[Failure]:
        """All failures written so far; a last line cut short by a crash is dropped."""
        if not self.path.is_file():
            return []
        failures = []
        for line in self.path.read_text(encoding="utf-8").splitlines():
            try:
                failures.append(Failure(**json.loads(line)))
            except (json.JSONDecodeError, TypeError):
                continue
        return failures

    def append(self, failures: Iterable[Failure]) -> None:
        """Add lines."""
        with self.path.open("a", encoding="utf-8") as file:
            file.writelines(json.dumps(asdict(failure)) + "\n" for failure in failures)

    def keep_only(self, seeds: set[int]) -> None:
        """Drop the lines of seeds that will be run again."""
        kept = [failure for failure in self.read() if failure.seed in seeds]
        with replacing(self.path) as tmp:
            tmp.write_text("".join(json.dumps(asdict(f)) + "\n" for f in kept), encoding="utf-8")


def count_by_stage(failures: Iterable[Failure]) -> dict[str, int]:
    """``{"stage: reason": count}``, most frequent first."""
    return dict(Counter(f"{f.stage}: {f.reason}" for f in failures if not f.gave_up).most_common())
