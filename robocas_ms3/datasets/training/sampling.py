"""From a sample's number to its episode and step and back, and weights that balance what is drawn."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import DatasetError


class SampleIndex:
    """Samples of some episodes, one after the other; arrays only, so that workers share their memory.

    Args:
        samples: episode number -> its steps that have a sample, without gaps.
    """

    def __init__(self, samples: Mapping[int, range]) -> None:
        self._numbers = np.array(list(samples), dtype=np.int64)
        self._first = np.array([steps.start for steps in samples.values()], dtype=np.int64)
        self._offsets = np.concatenate([[0], np.cumsum([len(steps) for steps in samples.values()], dtype=np.int64)])
        self._place = {number: place for place, number in enumerate(samples)}

    def __len__(self) -> int:
        return int(self._offsets[-1])

    def locate(self, index: int) -> tuple[int, int]:
        """Episode number and step of a sample.

        Raises:
            IndexError: there is no such sample.
        """
        if not -len(self) <= index < len(self):
            raise IndexError(f"sample {index} of {len(self)}")
        index %= len(self)
        place = int(np.searchsorted(self._offsets, index, side="right")) - 1
        return int(self._numbers[place]), int(self._first[place] + index - self._offsets[place])

    def indices(self, number: int) -> range:
        """Samples of an episode.

        Raises:
            DatasetError: it is not among the episodes.
        """
        if number not in self._place:
            raise DatasetError("no such episode in this split", where=f"episode {number}")
        place = self._place[number]
        return range(int(self._offsets[place]), int(self._offsets[place + 1]))

    def index(self, number: int, step: int) -> int:
        """The sample of a step.

        Raises:
            DatasetError: the episode is not here, or that step has no sample.
        """
        found = self.indices(number)
        first = int(self._first[self._place[number]])
        if not first <= step < first + len(found):
            expected = f"{first} to {first + len(found) - 1}" if found else "none"
            raise DatasetError("no sample of this step", where=f"episode {number}", expected=expected, found=step)
        return found[step - first]


def balancing_weights(kinds: NDArray[np.integer]) -> NDArray[np.float64]:
    """Weights (N,), sum 1, with which each kind that occurs is drawn equally often, and all of one kind too.

    Args:
        kinds: (N,) of each sample.
    """
    _, inverse, counts = np.unique(kinds, return_inverse=True, return_counts=True)
    return 1.0 / (len(counts) * counts[inverse])
