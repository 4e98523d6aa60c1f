"""Results of seeds, lines of ``failures.jsonl``, and initial states of expert interventions.

``failures.jsonl`` has one line per failed attempt and one line per skipped seed.
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
from robocas_ms3.planning.decisions import CpuSeconds

FAILURES_FILE = "failures.jsonl"
WITH_NOISE = "_with_noise"  # suffix of the reasons of attempts that failed only with noise


@dataclass(frozen=True)
class FailedAttempt:
    """A failed attempt at an episode, or a skipped seed: a line of ``failures.jsonl``.

    Attributes:
        attempt: number of the attempt, from 0; -1 marks a skipped seed.
        stage: stage of the policy that failed.
        reason: a short fixed text, which reports count.
        seconds: wall-clock time of the attempt; 0 if the process was killed before the line was written.
    """

    seed: Annotated[int, Field(ge=0, le=MAX_SEED)]
    attempt: Annotated[int, Field(ge=-1, le=10**6)]
    stage: str
    reason: str
    seconds: Annotated[float, Field(ge=0, le=1e9)]

    @property
    def skipped(self) -> bool:
        """Whether this line marks a skipped seed."""
        return self.attempt < 0


@dataclass
class EpisodeResult:
    """Result of a seed; forked processes send theirs to the parent process.

    Attributes:
        steps: length of the episode in control steps.
        attempts: number of attempts, the successful one included.
        seconds: CPU seconds by part.
        failures: all failed attempts.
        max_attempts: number of failed attempts after which the seed is skipped.
        attempt_start: start of the current attempt, ``time.perf_counter()`` in s.
    """

    seed: int
    success: bool
    steps: int = 0
    attempts: int = 0
    seconds: CpuSeconds = field(default_factory=CpuSeconds)
    failures: list[FailedAttempt] = field(default_factory=list)
    max_attempts: int = 1
    attempt_start: float = field(default_factory=time.perf_counter)

    @property
    def noise_failures(self) -> int:
        """Number of attempts that failed only with noise."""
        return sum(failure.reason.endswith(WITH_NOISE) for failure in self.failures)

    @property
    def has_no_attempts_left(self) -> bool:
        return len(self.failures) >= self.max_attempts

    def add_failure(self, error: PlanningError) -> None:
        """Add a failed attempt that ended now, and start the clock of the next one."""
        now = time.perf_counter()
        seconds = round(now - self.attempt_start, 3)
        self.failures.append(FailedAttempt(self.seed, len(self.failures), error.stage, error.reason, seconds))
        self.attempt_start = now

    def copy_from(self, other: EpisodeResult) -> None:
        """Take over all values of another result."""
        vars(self.seconds).update(vars(other.seconds))  # in place, since the executor adds to this object
        vars(self).update({key: value for key, value in vars(other).items() if key != "seconds"})


@dataclass(frozen=True)
class Intervention:
    """Initial state of an expert intervention: the state in which a learned policy left a scene.

    Attributes:
        policy: name of the policy that acted first.
        policy_steps: number of policy steps before the intervention.
        state: argument of ``set_state_dict``, each array (1, D) float32 or bool; without controller targets.
        gripper: last gripper command, -1 closed or 1 open.
        skip_reason: why the seed is skipped, a short fixed text; empty if the scripted policy can continue.
    """

    seed: int
    policy: str
    policy_steps: int
    state: dict[str, dict[str, NDArray[Any]]]
    gripper: float
    skip_reason: str = ""


def restore_failed_attempts(
    seed: int, recorded: Iterable[str], logged: Mapping[int, FailedAttempt]
) -> list[FailedAttempt]:
    """Return the failed attempts of a recorded seed.

    Args:
        recorded: ``stage: reason`` of each attempt, from the recording.
        logged: lines of ``failures.jsonl`` by attempt; they add the seconds.
    """
    failures = []
    for attempt, text in enumerate(recorded):
        stage, _, reason = text.partition(": ")
        line = logged.get(attempt)
        same = line is not None and (line.stage, line.reason) == (stage, reason)
        failures.append(line if line and same else FailedAttempt(seed, attempt, stage, reason, 0.0))
    return failures


def count_by_reason(failures: Iterable[FailedAttempt]) -> dict[str, int]:
    """Return ``{"stage: reason": count}``, most frequent first."""
    return dict(Counter(f"{f.stage}: {f.reason}" for f in failures if not f.skipped).most_common())
