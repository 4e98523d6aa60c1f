"""Make probe objects for the test of a surface, and measure the free height above the surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull

from robocas_ms3.assets.manifest import Surface

Array = np.ndarray

WIDTH = 0.05  # m, width of a probe
HEIGHT = 0.1  # m, largest height of a probe
EDGE = 0.005  # m, distance from the surface's edge
SPACING = 0.15  # m, smallest distance between probes
MOST = 5  # maximum number of probes along a side
BLOCKED = 0.01  # m; geometry up to this height above the surface belongs to the surface


@dataclass(frozen=True)
class Probe:
    """A box or cylinder that is placed on a surface in a test.

    Attributes:
        xy: (2,) position of the centre in the furniture's frame, m.
        corners: (V, 3) corners relative to this position, with the bottom at z = 0, m.
    """

    xy: Array
    corners: Array


def make_probes(surface: Surface) -> list[Probe]:
    """Return boxes and cylinders, 5 cm wide, on a grid over a surface; [] if the surface is too small."""
    low = np.add(surface.min_xy, WIDTH / 2 + EDGE)
    high = np.subtract(surface.max_xy, WIDTH / 2 + EDGE)
    if (high < low - 1e-9).any():
        return []
    axes = []
    for side in range(2):
        count = min(MOST, 1 + int(max(0.0, (high - low)[side]) / SPACING))
        axes.append(np.linspace(low[side], high[side], count) if count > 1 else (low + high)[side : side + 1] / 2)
    height = min(HEIGHT, (surface.headroom or np.inf) - 0.002)
    spots = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    return [Probe(xy, _prism(4 if index % 2 else 16, height)) for index, xy in enumerate(spots)]


def _prism(sides: int, height: float) -> Array:
    angles = (np.arange(sides) + 0.5) * 2 * np.pi / sides
    radius = WIDTH / 2 / np.cos(np.pi / sides)
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=1) * radius
    return np.concatenate([np.column_stack([ring, np.full(sides, z)]) for z in (0.0, height)])


def measure_clearances(pieces: Sequence[Array], points: Array) -> tuple[Array, Array]:
    """Measure the free height below and above points.

    Args:
        pieces: corners (V, 3) of each convex hull, m.
        points: (P, 3) points, m.

    Returns:
        The vertical distance (P,) from each point down to the nearest hull, and the distance (P,) up, m. A distance is
        infinite if there is no hull in this direction, and 0 inside a hull.
    """
    below, above = np.full(len(points), np.inf), np.full(len(points), np.inf)
    for piece in pieces:
        planes = ConvexHull(piece).equations
        slope, offset = planes[:, 2], points @ planes[:, :3].T + planes[:, 3]  # inside: offset + slope t <= 0
        upright = np.abs(slope) < 1e-9
        missed = (offset[:, upright] > 0).any(axis=1)
        times = -offset[:, ~upright] / slope[~upright]
        enter = np.where(slope[~upright] < 0, times, -np.inf).max(axis=1)
        leave = np.where(slope[~upright] > 0, times, np.inf).min(axis=1)
        hit = ~missed & (enter < leave)
        above[hit & (leave >= 0)] = np.minimum(above, enter.clip(0))[hit & (leave >= 0)]
        below[hit & (enter <= 0)] = np.minimum(below, (-leave).clip(0))[hit & (enter <= 0)]
    return below, above
