"""Heat maps of where objects stood at the beginning of episodes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.datasets.statistics.described import rounded
from robocas_ms3.datasets.statistics.facts import Facts

Array = NDArray[np.float64]

CELL = 0.05  # m
MARGIN = 0.3  # m around the region that layouts are sampled in; heaps slide out of it


@dataclass(frozen=True)
class LayoutMap:
    """Where objects stood at the beginning of the episodes of one configuration.

    Attributes:
        frame: of the positions: a piece of furniture's, or the world's.
        region: [min_xy, max_xy] that layouts are sampled in, m; None: not known.
        x_edges, y_edges: of the cells, m.
        counts: (nx, ny) objects in each cell.
        outside: objects farther from the region than ``MARGIN``, in no cell.
        targets: (N, 2) m, of the episodes' targets.
        episodes: that were counted.
    """

    frame: str
    region: list[list[float]] | None
    x_edges: Array
    y_edges: Array
    counts: NDArray[np.int64]
    outside: int
    targets: Array
    episodes: int

    @property
    def coverage(self) -> float | None:
        """Share of the region's cells that an object's centre was ever in; None without a region."""
        if self.region is None:
            return None
        (x0, y0), (x1, y1) = self.region
        x, y = (self.x_edges[:-1] + self.x_edges[1:]) / 2, (self.y_edges[:-1] + self.y_edges[1:]) / 2
        inside = np.outer((x > x0) & (x < x1), (y > y0) & (y < y1))
        return float(np.mean(self.counts[inside] > 0)) if inside.any() else None

    def as_json(self) -> dict[str, Any]:
        """Its form in ``stats.json``."""
        return {
            "frame": self.frame,
            "region": self.region,
            "episodes": self.episodes,
            "objects": int(self.counts.sum()) + self.outside,
            "outside": self.outside,
            "coverage": rounded(self.coverage),
            "x_edges": rounded(self.x_edges),
            "y_edges": rounded(self.y_edges),
            "counts": self.counts.tolist(),
            "targets": rounded(self.targets),
        }


def layout_map(parts: list[Facts]) -> LayoutMap:
    """Heat map of the layouts of one configuration, in its furniture's frame where that is known for all."""
    surface = parts[0].surface
    if surface is None or any(part.surface != surface for part in parts):
        surface = None
    placed = [part.positions if surface is None else surface.place(part.positions) for part in parts]
    points = np.concatenate(placed)
    targets = [xy[part.target_index] for part, xy in zip(parts, placed, strict=True) if part.target_index is not None]
    region = surface.region if surface else None
    low, high = np.asarray(region) if region else (points.min(0), points.max(0))
    near = points[((points >= low - MARGIN) & (points <= high + MARGIN)).all(axis=1)]
    x_edges, y_edges = (_edges(low[axis], high[axis], near[:, axis]) for axis in (0, 1))
    counts = np.histogramdd(near, bins=(x_edges, y_edges))[0].astype(np.int64)
    where = surface.label if surface else "world"
    outside = len(points) - int(counts.sum())
    return LayoutMap(where, region, x_edges, y_edges, counts, outside, np.array(targets).reshape(-1, 2), len(parts))


def _edges(low: float, high: float, points: Array) -> Array:
    """Edges of equal cells of about ``CELL`` that divide [low, high], and as many more as the points need."""
    cell = (high - low) / max(1, round((high - low) / CELL)) if high - low > CELL / 2 else CELL
    before = np.ceil((low - points.min(initial=low)) / cell - 1e-9)
    after = np.ceil((points.max(initial=high) - low) / cell - 1e-9)
    return low + cell * np.arange(-int(before), max(1, int(after)) + 1, dtype=np.float64)
