"""Statistics of features in the format of LeRobot: min, max, mean, std, count and quantiles."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
_FINE = 300  # pixels; larger images are subsampled for statistics, as in LeRobot
_THINNED = 150

Stats = dict[str, Any]


def compute_stats(values: NDArray) -> Stats:
    """Compute the statistics of a feature (T, D): each is a list of D numbers, ``count`` is [T]."""
    values = values.astype(np.int64) if values.dtype == bool else values
    numbers = values.astype(np.float64)
    quantiles = np.quantile(numbers, list(QUANTILES.values()), axis=0)
    return {
        "min": values.min(axis=0).tolist(),
        "max": values.max(axis=0).tolist(),
        "mean": numbers.mean(axis=0).tolist(),
        "std": numbers.std(axis=0).tolist(),
        "count": [len(values)],
        **{name: row.tolist() for name, row in zip(QUANTILES, quantiles, strict=True)},
    }


def compute_dataset_stats(episodes: Sequence[NDArray]) -> Stats:
    """Compute the statistics of a feature over all episodes, one column after another to save memory.

    ``episodes``: values (T, D) per episode.
    """
    columns = (np.concatenate([values[:, [n]] for values in episodes]) for n in range(episodes[0].shape[1]))
    found = [compute_stats(column) for column in columns]
    return {name: found[0][name] if name == "count" else [one[name][0] for one in found] for name in found[0]}


class LevelHistogram:
    """Histogram (channels, levels) of pixel values, from which statistics of images are computed exactly.

    RGB images have 3 channels, and statistics between 0 and 1. Depth images have one channel, and statistics in mm.
    """

    def __init__(self, counts: ArrayLike, images: int = 0) -> None:
        self.counts, self.images = np.array(counts, np.int64), images
        self._unit = 1.0 if len(self.counts) == 1 else 1 / 255

    @classmethod
    def make_rgb(cls) -> LevelHistogram:
        return cls(np.zeros((3, 256)))

    @classmethod
    def make_depth(cls) -> LevelHistogram:  # 12 bits
        return cls(np.zeros((1, 4096)))

    def add(self, image: NDArray) -> None:
        """Count the pixels of an image, (H, W, C) or (H, W); large images are subsampled."""
        longest = max(image.shape[:2])
        step = longest // _THINNED if longest >= _FINE else 1
        channels, levels = self.counts.shape
        thinned = image[::step, ::step].reshape(-1, channels)
        for channel in range(channels):
            self.counts[channel] += np.bincount(thinned[:, channel], minlength=levels)
        self.images += 1

    def merge(self, other: LevelHistogram) -> None:
        self.counts += other.counts
        self.images += other.images

    def stats(self) -> Stats:
        """Compute the statistics, each with shape (channels, 1, 1); ``count`` is [number of images]."""
        values = np.arange(self.counts.shape[1]) * self._unit
        total = self.counts.sum(axis=1)
        mean = self.counts @ values / total
        variance = self.counts @ values**2 / total - mean**2
        below = np.cumsum(self.counts, axis=1)
        found = {
            "min": values[(self.counts > 0).argmax(axis=1)],
            "max": values[len(values) - 1 - (self.counts[:, ::-1] > 0).argmax(axis=1)],
            "mean": mean,
            "std": np.sqrt(np.maximum(variance, 0)),
        }
        for name, quantile in QUANTILES.items():
            found[name] = values[(below < quantile * total[:, None]).sum(axis=1)]
        shaped = {name: row.reshape(-1, 1, 1).tolist() for name, row in found.items()}
        return {**shaped, "count": [self.images]}
