"""Where the time of an episode goes."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass


@dataclass
class Seconds:
    """Where an episode's time went: CPU seconds of this process and of all its branches that could be played."""

    reset: float = 0.0
    planning: float = 0.0
    simulation: float = 0.0
    trial: float = 0.0

    @contextmanager
    def spent_on(self, part: str) -> Iterator[None]:
        """Add the time spent inside to a part."""
        start = time.process_time()
        try:
            yield
        finally:
            setattr(self, part, getattr(self, part) + time.process_time() - start)
