"""A tally for tests of branches."""

from __future__ import annotations

from dataclasses import dataclass, field

from robocas_ms3.core.errors import PlanningFailed


@dataclass
class Notes:
    """Failures so far, and what the episode came to."""

    most: int = 100
    failures: list[str] = field(default_factory=list)
    outcome: str = ""

    @property
    def exhausted(self) -> bool:
        return len(self.failures) >= self.most

    def failed(self, error: PlanningFailed) -> None:
        self.failures.append(f"{error.stage}: {error.reason}")

    def adopt(self, other) -> None:
        vars(self).update(vars(other))
