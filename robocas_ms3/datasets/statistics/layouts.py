"""Heat maps of object positions at the start of the episodes of a configuration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
CELL = 0.05  # m
MARGIN = 0.3  # m around the region in which layouts are sampled; heaps extend beyond it


@dataclass(frozen=True)
class Surface:
    """Surface on which objects are placed.

    Attributes:
        label: name of the furniture and of the surface.
        x: position of the furniture in the world, m.
        y: position of the furniture in the world, m.
        yaw: rotation of the furniture in the world, rad.
        region: [min_xy, max_xy] in which layouts are sampled, in the furniture frame, m; None: unknown.
    """

    label: str
    x: float
    y: float
    yaw: float
    region: list[list[float]] | None

    def to_furniture_frame(self, xy: Array) -> Array:
        """Convert positions (N, 2) from the world frame to the furniture frame, m."""
        cosine, sine = np.cos(self.yaw), np.sin(self.yaw)
        return (xy - [self.x, self.y]) @ np.array([[cosine, -sine], [sine, cosine]])


@dataclass(frozen=True)
class ObjectPositions:
    """Positions of the objects at the start of an episode.

    Attributes:
        positions: (N, 2) x and y in the world frame, m.
        target: index of the target in ``positions``; None: unknown.
        surface: surface on which the objects are placed; None: unknown.
    """

    positions: Array
    target: int | None = None
    surface: Surface | None = None


@dataclass(frozen=True)
class LayoutMap:
    """Heat map of object positions at the start of the episodes of a configuration, m.

    Attributes:
        frame: frame of the positions: a furniture surface, or the world.
        region: [min_xy, max_xy] in which layouts are sampled; None: unknown.
        x_edges: (nx + 1,) cell edges along x.
        y_edges: (ny + 1,) cell edges along y.
        counts: (nx, ny) number of objects per cell.
        outside: number of objects farther than ``MARGIN`` from the region, in no cell.
        targets: (K, 2) positions of the targets.
        episodes: number of episodes.
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
        """Fraction of the cells of the region with an object centre in any episode; None without a region."""
        if self.region is None:
            return None
        (x0, y0), (x1, y1) = self.region
        x, y = (self.x_edges[:-1] + self.x_edges[1:]) / 2, (self.y_edges[:-1] + self.y_edges[1:]) / 2
        inside = np.outer((x > x0) & (x < x1), (y > y0) & (y < y1))
        return float(np.mean(self.counts[inside] > 0)) if inside.any() else None

    def as_json(self) -> dict[str, Any]:
        return {
            "frame": self.frame,
            "region": self.region,
            "episodes": self.episodes,
            "objects": int(self.counts.sum()) + self.outside,
            "outside": self.outside,
            "coverage": round_values(self.coverage),
            "x_edges": round_values(self.x_edges),
            "y_edges": round_values(self.y_edges),
            "counts": self.counts.tolist(),
            "targets": round_values(self.targets),
        }


def make_layout_map(placements: list[ObjectPositions]) -> LayoutMap:
    """Compute the heat map of object positions over episodes of one configuration.

    Its frame is the furniture frame if all episodes have the same surface, otherwise the world frame.
    """
    surface = placements[0].surface
    if surface is None or any(placement.surface != surface for placement in placements):
        surface = None
    placed = [p.positions if surface is None else surface.to_furniture_frame(p.positions) for p in placements]
    points = np.concatenate(placed)
    targets = [xy[p.target] for p, xy in zip(placements, placed, strict=True) if p.target is not None]
    region = surface.region if surface else None
    low, high = np.asarray(region) if region else (points.min(0), points.max(0))
    near = points[((points >= low - MARGIN) & (points <= high + MARGIN)).all(axis=1)]
    x_edges, y_edges = (_make_edges(low[axis], high[axis], near[:, axis]) for axis in (0, 1))
    counts = np.histogramdd(near, bins=(x_edges, y_edges))[0].astype(np.int64)
    frame = surface.label if surface else "world"
    outside = len(points) - int(counts.sum())
    return LayoutMap(
        frame, region, x_edges, y_edges, counts, outside, np.array(targets).reshape(-1, 2), len(placements)
    )


def _make_edges(low: float, high: float, points: Array) -> Array:
    """Make the edges of equal cells of about ``CELL`` m that divide [low, high] and cover all points."""
    cell = (high - low) / max(1, round((high - low) / CELL)) if high - low > CELL / 2 else CELL
    before = np.ceil((low - points.min(initial=low)) / cell - 1e-9)
    after = np.ceil((points.max(initial=high) - low) / cell - 1e-9)
    return low + cell * np.arange(-int(before), max(1, int(after)) + 1, dtype=np.float64)


def find_surface(config: dict[str, Any]) -> Surface | None:
    """Find the surface of a task configuration; None: it has no surface.

    An invalid configuration raises KeyError, TypeError or another error.
    """
    surface = config.get("surface")
    if not surface:
        return None
    pose = config["furniture"][surface["furniture"]]["pose"]
    region = [list(surface[key]) for key in ("min_xy", "max_xy")] if surface.get("min_xy") else None
    x, y, _ = pose["position"]
    yaw = float(np.deg2rad(pose.get("yaw_deg", 0.0)))
    return Surface(f"{surface['furniture']}, {surface['name']}", x, y, yaw, region)


def round_values(value: Any) -> Any:
    return None if value is None else np.round(value, 6).tolist()
