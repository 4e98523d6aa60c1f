"""Where the time of a conversion goes."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass


@dataclass
class Timing:
    """Seconds that an episode took, or several.

    Attributes:
        load: reading the recording and building its scene; of a dataset, reading its pictures.
        render: showing states.
        encode: pictures (on other threads, beside rendering) or videos.
        wait: how long rendering stood still for pictures to be encoded.
        write: arrays, JSON, renaming; joining videos and tables.
        total: all of it, as the clock has it.
    """

    load: float = 0.0
    render: float = 0.0
    encode: float = 0.0
    wait: float = 0.0
    write: float = 0.0
    total: float = 0.0

    def __add__(self, other: Timing) -> Timing:
        """Part by part."""
        more = asdict(other)
        return Timing(**{part: seconds + more[part] for part, seconds in asdict(self).items()})

    @contextmanager
    def measure(self, part: str) -> Iterator[None]:
        """Add what is done inside to a part."""
        begun = time.perf_counter()
        try:
            yield
        finally:
            setattr(self, part, getattr(self, part) + time.perf_counter() - begun)
