"""Parametric fruit, see ``shapes``."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.interpolate import CubicSpline

from asset_tools.builtin.mesh import Shape, Size, fitted
from asset_tools.builtin.surfaces import Section, chained_pieces, loft, stacked_pieces, sweep


def _spline_rings(points: Sequence[tuple[float, float]], count: int) -> np.ndarray:
    """Rings (count, 4) of a smooth profile through (radius, z), level where it meets the axis at both ends."""
    line = np.array(points)
    t = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    spline = CubicSpline(t, line, bc_type=((1, [1.0, 0.0]), (1, [-1.0, 0.0])))  # pyright: ignore[reportArgumentType]
    smooth = spline(np.linspace(0, t[-1], count))
    smooth[[0, -1], 0] = 0
    return np.column_stack([smooth[:, 0], smooth[:, 0], smooth[:, 1], np.full(count, 2.0)])


def fruit(
    size: Size,
    *,
    profile: Sequence[tuple[float, float]],
    lobes: float = 0.0,
    lean: float = 0.0,
    groove: float = 0.0,
    stem: tuple[float, float, float] | None = None,
    cuts: Sequence[float] = (),
    rings: int = 25,
) -> Shape:
    """A body of revolution made a little irregular. Regions: skin (angle to the right, profile upwards), stem.

    Args:
        size: outer size with the stem, m.
        profile: (radius, z) from the bottom's centre to the top's, m; a spline goes through them.
        lobes: depth of five lobes towards the bottom, as a fraction of the radius.
        lean: how far the top is moved sideways (+x), as a fraction of the height.
        groove: depth of a groove along the front, as a fraction of the radius.
        stem: z of the stem's foot and tip, and its radius, m.
        cuts: heights at which the profile is concave, m.
        rings: along the profile.
    """
    heights = [z for _, z in profile]
    bottom, height = min(heights), max(heights) - min(heights)

    def warp(points: np.ndarray) -> np.ndarray:
        angle = np.arctan2(points[..., 1], points[..., 0])
        level = (points[..., 2] - bottom) / height
        off_front = np.angle(np.exp(1j * (angle + np.pi / 2)))
        factor = 1 + lobes * np.cos(5 * angle) * (1 - level) ** 2 + 0.4 * lobes * np.cos(2 * angle + 0.7) * level
        factor = factor - groove * np.exp(-((off_front / 0.22) ** 2))
        moved = points * np.stack([factor, factor, np.ones_like(factor)], axis=-1)
        moved[..., 0] += lean * height * np.clip(level, 0, 1) ** 2
        return moved

    parts = [loft([Section("skin", _spline_rings(profile, rings))], segments=28, warp=warp)]
    pieces = stacked_pieces(parts[0], cuts)
    if stem:
        foot, tip, radius = stem
        t = np.linspace(0, 1, 7)
        path = np.stack([lean * height + 0.004 * t**2, 0 * t, foot + (tip - foot) * t], axis=-1)
        radii = np.repeat((radius * (1 - 0.5 * t + 0.7 * t**4))[:, None], 2, axis=1)
        path, radii = np.concatenate([path[:1], path, path[-1:]]), np.concatenate([[[0, 0]], radii, [[0, 0]]])
        path[-1, 2] += 1e-4
        path[0, 2] -= 1e-4
        parts.append(sweep("stem", path, radii, normal=(0, 1, 0), segments=8, detail=0.6))
        pieces += chained_pieces(parts[1][0], 1)
    return fitted(parts, size, pieces=pieces)


def round_fruit(
    size: Size, *, radius: float, flatness: float, dimple: float, lobes: float = 0.0, groove: float = 0.0
) -> Shape:
    """A fruit that is a flattened ball with a dimple at the top.

    Args:
        size: see ``fruit``. radius: of the ball, m. flatness: its height as a fraction of its width.
        dimple: its depth, m. lobes, groove: see ``fruit``.
    """
    angles = np.linspace(0, np.pi, 9)
    line = [(float(radius * np.sin(a)), float(-radius * flatness * np.cos(a))) for a in angles]
    line[-1] = (0.0, line[-1][1] - dimple)
    return fruit(size, profile=line, lobes=lobes, groove=groove)


def banana(size: Size) -> Shape:
    """A banana on its side, bent in the xy plane. Region: skin (around to the right, stem to tip upwards)."""
    chord, thick = size[0], size[2] / 2
    t = np.linspace(0, 1, 37)
    # The bend is stronger in the middle and the stem goes straight on.
    heading = 1.0 - 2.0 * np.clip((t - 0.08) / 0.92, 0, 1) ** 0.9
    step = np.stack([np.cos(heading), np.sin(heading), 0 * t], axis=-1)
    path = np.cumsum(step, axis=0)
    path = (path - path[0]) * (chord * 0.985 / np.ptp(path[:, 0]))
    shape = np.interp(
        t,
        [0, 0.02, 0.09, 0.16, 0.27, 0.45, 0.65, 0.82, 0.92, 0.97, 1.0],
        [0.26, 0.3, 0.29, 0.42, 0.84, 1, 1, 0.85, 0.53, 0.28, 0.2],
    )
    shape = np.convolve(np.pad(shape, 2, mode="edge"), [0.1, 0.2, 0.4, 0.2, 0.1], mode="valid")
    radii = np.repeat((thick * shape)[:, None], 2, axis=1)
    path, radii = np.concatenate([path[:1], path, path[-1:]]), np.concatenate([[[0, 0]], radii, [[0, 0]]])
    path[0] -= step[0] * 1e-4
    path[-1] += step[-1] * 1e-4
    theta = 2 * np.pi * np.arange(20) / 20
    section = 1 + 0.045 * np.cos(5 * theta)
    part = sweep("skin", path, radii, normal=(0, 0, 1), section=section, segments=20)
    return fitted([part], size, pieces=chained_pieces(part[0], 6))
