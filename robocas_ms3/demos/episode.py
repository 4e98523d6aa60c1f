"""How episodes are generated, and what became of one."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any

from robocas_ms3.core.errors import PlanningFailed
from robocas_ms3.demos.ledger import Failure
from robocas_ms3.planning.backends import DEFAULT
from robocas_ms3.planning.seconds import Seconds
from robocas_ms3.robots.table import DEFAULT as DEFAULT_ROBOT
from robocas_ms3.scenes.config import TaskConfig
from robocas_ms3.scenes.task_specs import STANDARD_FREQ

AFTER_STEPS = 5, 60
NOISY = "noisy_"  # begins the reasons of attempts that failed for noise alone


@dataclass(frozen=True)
class EpisodeSettings:
    """How episodes are generated; the same for all seeds of a run.

    Attributes:
        task: short name of the task.
        config: name of a shipped configuration, or the whole of one.
        pack: name or folder of the object pack.
        control_freq: Hz.
        max_attempts: attempts a seed has.
        keep_recoveries: leave failed attempts in the record instead of undoing them.
        replay_rate: Hz; an attempt counts only if its own actions, as a dataset of this rate holds them, succeed again
            open loop (`trials`), and none goes beyond [-1, 1]. 0: not tried; nor is it where the base drives, which
            those actions leave out.
        noisy_trials: how often they are tried with noise, besides once without.
        noisy_failures: attempts that may fail for noise alone; after so many an episode counts without, and says so.
        noise_mm: its standard deviation, of each component of each action's translation, mm.
        noise_deg: the same of its Euler angles.
        layouts: where layouts come from, see ``RoboCASEnv``.
        planner: name of the motion planner.
        robot: name of the robot.
        after_policy: name of a policy that acts first; the scripted one takes over from it (`takeover`). Empty: none.
        after_steps: least and most steps for which it acts.
    """

    task: str
    config: str | dict[str, Any]
    pack: str
    control_freq: int = STANDARD_FREQ
    max_attempts: int = 20
    keep_recoveries: bool = False
    replay_rate: int = 5
    noisy_trials: int = 1
    noisy_failures: int = 1
    noise_mm: float = 0.5
    noise_deg: float = 0.2
    layouts: str = "auto"
    planner: str = DEFAULT
    robot: str = DEFAULT_ROBOT
    after_policy: str = ""
    after_steps: tuple[int, int] = AFTER_STEPS


@dataclass
class EpisodeResult:
    """What became of a seed; processes that branch off hand it on (`backtracking.Tally`).

    Attributes:
        seed: of the episode.
        success: whether an episode was recorded.
        steps: its length in control steps.
        attempts: attempts used.
        seconds: where the time went.
        failures: every attempt that failed.
        max_attempts: after so many the seed is given up.
        begun: when the attempt did, s of the clock.
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
        """How many attempts failed for noise alone."""
        return sum(failure.reason.startswith(NOISY) for failure in self.failures)

    @property
    def exhausted(self) -> bool:
        """Whether the seed is given up."""
        return len(self.failures) >= self.max_attempts

    def failed(self, error: PlanningFailed) -> None:
        """Note a failed attempt."""
        now = time.perf_counter()
        self.failures.append(
            Failure(self.seed, len(self.failures), error.stage, error.reason, round(now - self.begun, 3))
        )
        self.begun = now

    def adopt(self, other: EpisodeResult) -> None:
        """Become what another process sent."""
        vars(self.seconds).update(vars(other.seconds))  # the executor counts on in these
        vars(self).update({key: value for key, value in vars(other).items() if key != "seconds"})


def recordable_config(config: TaskConfig, name: str | None) -> str | dict[str, Any]:
    """What a record says of its configuration: the name of a shipped one, else the whole of it (no local path)."""
    return name if name is not None else config.model_dump(mode="json")
