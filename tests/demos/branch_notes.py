"""Episode result for tests of decisions, with failures as text."""

from __future__ import annotations

from dataclasses import dataclass

from robocas_ms3.demos.failures import EpisodeResult


@dataclass
class Notes(EpisodeResult):
    seed: int = 0
    success: bool = False
    max_attempts: int = 100
    outcome: str = ""

    @property
    def texts(self) -> list[str]:
        return [f"{failure.stage}: {failure.reason}" for failure in self.failures]
