"""Many numbers in a few, as ``stats.json`` holds them: counts, percentiles, histograms."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

BINS = 41  # of histograms; odd, so that standing still has a bin of its own


def counted(counter: Mapping[str, int]) -> dict[str, int]:
    """The most frequent first, those of one frequency by name."""
    return dict(sorted(counter.items(), key=lambda item: (-item[1], item[0])))


def described(values: Iterable[float] | NDArray) -> dict[str, Any]:
    """Count, mean, deviation and percentiles."""
    array = np.asarray(list(values) if not isinstance(values, np.ndarray) else values, dtype=np.float64)
    if not len(array):
        return {"count": 0}
    low, p1, p10, median, p90, p99, high = np.percentile(array, [0, 1, 10, 50, 90, 99, 100])
    found = dict(mean=array.mean(), std=array.std(), min=low, p1=p1, p10=p10, median=median, p90=p90, p99=p99, max=high)
    return {"count": len(array), **{key: rounded(float(value)) for key, value in found.items()}}


def histogram(values: NDArray) -> dict[str, Any]:
    """Counts over equal bins, symmetric about 0 for what moves both ways, from 0 on for what does not."""
    if not len(values):
        return {"edges": [], "counts": []}
    reach = float(np.abs(values).max()) or 1.0
    edges = np.array([-0.5, 0.5, 1.5]) if set(np.unique(values)) <= {0, 1} else np.linspace(-reach, reach, BINS + 1)
    return {"edges": rounded(edges), "counts": np.histogram(values, edges)[0].tolist()}


def rounded(value: Any) -> Any:
    """Six digits after the point are enough."""
    return None if value is None else np.round(value, 6).tolist()
