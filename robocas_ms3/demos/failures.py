"""Results of seeds, the lines of ``failures.jsonl``, and starts that a policy left. Loads no simulator.

``failures.jsonl`` has one line per failed attempt, and one per seed that was given up.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any

from numpy.typing import NDArray
from pydantic import Field

from robocas_ms3.core.checks import MAX_SEED
from robocas_ms3.core.errors import PlanningError
from robocas_ms3.planning.decisions import Seconds

FAILURES_FILE = "failures.jsonl"
NOISY = "noisy_"  # begins the reasons of attempts that failed for noise alone


@dataclass(frozen=True)
class Failure:
    """A failed attempt.

    Attributes:
        attempt: counted from 0; -1 marks the seed as given up.
        stage: of the policy that failed.
        reason: why, in words that can be counted.
        seconds: wall-clock time of the attempt; 0 if a kill came before it was noted.
    """

    seed: Annotated[int, Field(ge=0, le=MAX_SEED)]
    attempt: Annotated[int, Field(ge=-1, le=10**6)]
    stage: str
    reason: str
    seconds: Annotated[float, Field(ge=0, le=1e9)]

    @property
    def gave_up(self) -> bool:
        return self.attempt < 0


@dataclass
class EpisodeResult:
    """Result of a seed; forked processes send theirs back.

    Attributes:
        steps: length in control steps.
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
    def noise_failures(self) -> int:
        return sum(failure.reason.startswith(NOISY) for failure in self.failures)

    @property
    def exhausted(self) -> bool:
        return len(self.failures) >= self.max_attempts

    def failed(self, error: PlanningError) -> None:
        now = time.perf_counter()
        seconds = round(now - self.begun, 3)
        self.failures.append(Failure(self.seed, len(self.failures), error.stage, error.reason, seconds))
        self.begun = now

    def adopt(self, other: EpisodeResult) -> None:
        vars(self.seconds).update(vars(other.seconds))  # the executor keeps counting in this object
        vars(self).update({key: value for key, value in vars(other).items() if key != "seconds"})


@dataclass(frozen=True)
class Takeover:
    """State in which a policy left a scene.

    Attributes:
        policy: its name.
        policy_steps: for which it acted.
        state: as ``set_state_dict`` takes it, each array (1, D) float32 or bool; without targets of controllers.
        gripper: last command of the gripper, -1 closed or 1 open.
        refused: why nothing can be taken over, in a few words that can be counted; empty: it can.
    """

    seed: int
    policy: str
    policy_steps: int
    state: dict[str, dict[str, NDArray[Any]]]
    gripper: float
    refused: str = ""


def failed_attempts(seed: int, recorded: Iterable[str], noted: Mapping[int, Failure]) -> list[Failure]:
    """Return the failed attempts of a recorded seed (``stage: reason`` each), with seconds where lines have them."""
    failures = []
    for attempt, text in enumerate(recorded):
        stage, _, reason = text.partition(": ")
        known = noted.get(attempt)
        same = known is not None and (known.stage, known.reason) == (stage, reason)
        failures.append(known if known and same else Failure(seed, attempt, stage, reason, 0.0))
    return failures


def count_by_stage(failures: Iterable[Failure]) -> dict[str, int]:
    """Return ``{"stage: reason": count}``, most frequent first."""
    return dict(Counter(f"{f.stage}: {f.reason}" for f in failures if not f.gave_up).most_common())
