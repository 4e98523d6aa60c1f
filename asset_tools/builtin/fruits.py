"""Make fruits of a given size, as in ``shapes``."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.interpolate import CubicSpline

from asset_tools.builtin.mesh import Shape, Size, build_fitted_shape
from asset_tools.builtin.surfaces import Section, loft, make_chained_pieces, make_stacked_pieces, sweep


def _spline_rings(points: Sequence[tuple[float, float]], count: int) -> np.ndarray:
    """Return ``count`` rings (count, 4) of a smooth profile through points (radius, z).

    Its ends are horizontal.
    """
    line = np.array(points)
    t = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    spline = CubicSpline(t, line, bc_type=((1, [1.0, 0.0]), (1, [-1.0, 0.0])))  # pyright: ignore[reportArgumentType]
    smooth = spline(np.linspace(0, t[-1], count))
    smooth[[0, -1], 0] = 0
    return np.column_stack([smooth[:, 0], smooth[:, 0], smooth[:, 1], np.full(count, 2.0)])


def make_fruit(
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
    """Make a fruit, a slightly irregular body of revolution; regions: skin, stem.

    Args:
        size: outer size (x, y, z) with the stem, m.
        profile: points (radius, z) of a spline from the centre of the bottom to the centre of the top, m.
        lobes: depth of five lobes towards the bottom, as a fraction of the radius.
        lean: shift of the top towards +x, as a fraction of the height.
        groove: depth of a groove along the front, as a fraction of the radius.
        stem: z of the lower end, z of the tip, and radius of the stem, m; None: no stem.
        cuts: heights at which the profile is concave, m.
        rings: number of rings along the profile.
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
    pieces = make_stacked_pieces(parts[0], cuts)
    if stem:
        foot, tip, radius = stem
        t = np.linspace(0, 1, 7)
        path = np.stack([lean * height + 0.004 * t**2, 0 * t, foot + (tip - foot) * t], axis=-1)
        radii = np.repeat((radius * (1 - 0.5 * t + 0.7 * t**4))[:, None], 2, axis=1)
        path, radii = np.concatenate([path[:1], path, path[-1:]]), np.concatenate([[[0, 0]], radii, [[0, 0]]])
        path[-1, 2] += 1e-4
        path[0, 2] -= 1e-4
        parts.append(sweep("stem", path, radii, normal=(0, 1, 0), segments=8, detail=0.6))
        pieces += make_chained_pieces(parts[1][0], 1)
    return build_fitted_shape(parts, size, pieces=pieces)


def make_round_fruit(
    size: Size, *, radius: float, flatness: float, dimple: float, lobes: float = 0.0, groove: float = 0.0
) -> Shape:
    """Make a fruit that is a flattened ball with a dimple at the top; region: skin.

    Args:
        size: outer size (x, y, z), m.
        radius: radius of the ball, m.
        flatness: height of the ball as a fraction of its width.
        dimple: depth of the dimple, m.
        lobes: depth of five lobes towards the bottom, as a fraction of the radius.
        groove: depth of a groove along the front, as a fraction of the radius.
    """
    angles = np.linspace(0, np.pi, 9)
    line = [(float(radius * np.sin(a)), float(-radius * flatness * np.cos(a))) for a in angles]
    line[-1] = (0.0, line[-1][1] - dimple)
    return make_fruit(size, profile=line, lobes=lobes, groove=groove)


def make_banana(size: Size) -> Shape:
    """Make a banana that lies on its side, bent in the xy plane; region: skin (tip at the top)."""
    chord, thick = size[0], size[2] / 2
    t = np.linspace(0, 1, 37)
    # the bend is stronger in the middle, and the stem is straight
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
    return build_fitted_shape([part], size, pieces=make_chained_pieces(part[0], 6))
