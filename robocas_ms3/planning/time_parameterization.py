"""Time-parameterise paths: joint positions at control steps within velocity and acceleration limits.

A joint path is a polyline with corners rounded by parabolas, which does not overshoot, unlike a spline through sparse
waypoints. A line of the TCP is a spline through dense configurations. TOPP-RA computes the fastest timing of both.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline, PPoly

from robocas_ms3.planning.protocol import Array, Trajectory

GRID = 0.04  # rad between grid points of TOPP-RA
SAFETY = 0.98  # fraction of the limits at grid points, so that they also hold in between


class JointPath:
    """Path in joint space, with the interface of TOPP-RA's `AbstractGeometricPath`.

    The path parameter is nearly the length of the path in rad (norm over joints).

    Args:
        curve: piecewise polynomial from the path parameter in [0, length] to configurations (n,).
        goal: (n,) last configuration, without rounding errors.
    """

    def __init__(self, curve: PPoly, goal: Array) -> None:
        self._curve, self.goal = curve, goal

    def __call__(self, path_positions: Array | float, order: int = 0) -> Array:
        """Return configurations (m, n), or derivatives of an order, at one or more path parameters (m,)."""
        return self._curve(path_positions, order)

    @property
    def dof(self) -> int:
        return int(self._curve.c.shape[2])

    @property
    def path_interval(self) -> Array:
        return self._curve.x[[0, -1]]

    @property
    def waypoints(self) -> Array:
        return self._curve.x

    @property
    def length(self) -> float:
        return float(self._curve.x[-1])

    def sample(self, spacing: float) -> Array:
        """Return configurations (m, n) at most ``spacing`` rad apart, with both ends of the path."""
        return self(np.linspace(0, self.length, max(2, int(np.ceil(self.length / spacing)) + 1), dtype=np.float64))

    def grid(self) -> Array:
        """Return path parameters (m,) for TOPP-RA: evenly spaced, and on both sides of each breakpoint."""
        even = np.linspace(0, self.length, max(20, int(np.ceil(self.length / GRID))) + 1, dtype=np.float64)
        inner = self._curve.x[1:-1] if len(self._curve.x) < 40 else self._curve.x[:0]
        near_breaks = np.concatenate([inner - 1e-4 * self.length, inner + 1e-4 * self.length])
        points = np.sort(np.concatenate([even, near_breaks[(near_breaks > 0) & (near_breaks < self.length)]]))
        return points[np.concatenate([[True], np.diff(points) > 1e-6 * self.length])]


def round_corners(waypoints: Array, radius: float) -> JointPath:
    """Round the corners of a polyline (m, n) by parabolas.

    A parabola starts at most ``radius`` rad before its corner.
    """
    points = np.asarray(waypoints, dtype=np.float64)
    steps = np.diff(points, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    directions = steps / lengths[:, None]
    cut = np.zeros(len(points))
    cut[1:-1] = np.minimum(radius, 0.5 * np.minimum(lengths[:-1], lengths[1:]))
    breaks, pieces = [0.0], []
    for i, direction in enumerate(directions):
        straight = lengths[i] - cut[i] - cut[i + 1]
        if straight > 1e-9:
            pieces.append((np.zeros_like(direction), direction, points[i] + cut[i] * direction))
            breaks.append(breaks[-1] + straight)
        r = cut[i + 1]
        if r > 0:
            bend = (directions[i + 1] - direction) / (4 * r)
            pieces.append((bend, direction, points[i + 1] - r * direction))
            breaks.append(breaks[-1] + 2 * r)
    return JointPath(PPoly(np.array(pieces).transpose(1, 0, 2), np.array(breaks)), points[-1])


def fit_spline(waypoints: Array) -> JointPath:
    """Fit a cubic spline to closely spaced configurations (m, n) of a smooth motion."""
    points = np.asarray(waypoints, dtype=np.float64)
    ends = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    return JointPath(CubicSpline(ends, points, bc_type="not-a-knot" if len(points) > 3 else "natural"), points[-1])


def blend_motions(first: Array, second: Array, rows: int) -> Array:
    """Overlap the end of a motion with the start of the next motion, which rounds the corner between them.

    Args:
        first: (T, n) configurations of the first motion at equal time steps; its last row is the start of the second.
        second: (U, n) configurations of the second motion at the same time step.
        rows: number of overlapping rows.

    Returns:
        (T + U - rows, n) configurations; outside of the overlap they are those of the two motions.
    """
    if not rows:
        return np.concatenate([first, second])
    return np.concatenate([first[:-rows], first[-rows:] + second[:rows] - first[-1], second[rows:]])


def thin_path(points: Array, spacing: float) -> Array:
    """Return configurations of a path (T, n) about ``spacing`` rad apart, with the first and the last."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    kept = np.unique(np.searchsorted(along, np.arange(0, max(along[-1] - spacing / 2, spacing / 2), spacing)))
    return points[[*kept, len(points) - 1]]


def time_path(path: JointPath, *, velocity: float, acceleration: float, dt: float) -> Trajectory | None:
    """Compute the fastest trajectory along a path from rest to rest; return None if TOPP-RA fails.

    The trajectory is slowed down to a whole number of time steps.

    Args:
        path: path in joint space.
        velocity: velocity limit of each joint, rad/s; `SAFETY` times this value is used.
        acceleration: acceleration limit of each joint, rad/s^2; `SAFETY` times this value is used.
        dt: time between rows, s.
    """
    from toppra.algorithm import TOPPRA  # imports matplotlib (0.2 s)

    bounds = _bounds(path.dof, velocity, acceleration)
    solver = TOPPRA(bounds, path, gridpoints=path.grid(), parametrizer="ParametrizeConstAccel")
    motion = solver.compute_trajectory(0.0, 0.0)
    if motion is None:
        return None
    duration = float(motion.path_interval[1])
    return sample_motion(motion, duration, path.goal, dt) if np.isfinite(duration) else None


@lru_cache(maxsize=64)  # TOPP-RA formats a description of each, a quarter of the time of timing
def _bounds(dof: int, velocity: float, acceleration: float) -> list[Any]:
    from toppra.constraint import JointAccelerationConstraint, JointVelocityConstraint

    ones = np.ones(dof) * SAFETY
    return [
        JointVelocityConstraint(np.stack([-ones, ones], 1) * velocity),
        JointAccelerationConstraint(np.stack([-ones, ones], 1) * acceleration),
    ]


def time_with_stops(waypoints: Array, *, velocity: float, acceleration: float, dt: float) -> Trajectory:
    """Compute a trajectory that stays on the lines of a polyline (m, n) and stops at each waypoint.

    Args:
        waypoints: (m, n) configurations, rad, or other positions with equal limits.
        velocity: velocity limit of each joint, rad/s; `SAFETY` times this value is used.
        acceleration: acceleration limit of each joint, rad/s^2; `SAFETY` times this value is used.
        dt: time between rows, s.
    """
    points = np.asarray(waypoints, dtype=np.float64)
    steps = np.diff(points, axis=0)
    largest = np.abs(steps).max(axis=1)  # the joint with the largest displacement determines the time
    cruise = np.minimum(SAFETY * velocity, np.sqrt(largest * SAFETY * acceleration))
    ramp = cruise / (SAFETY * acceleration)
    spans = largest / cruise + ramp
    ends = np.concatenate([[0.0], np.cumsum(spans)])

    def at(times: Array) -> Array:
        index = np.clip(np.searchsorted(ends, times, side="right") - 1, 0, len(steps) - 1)
        t, a, r, T = times - ends[index], SAFETY * acceleration, ramp[index], spans[index]
        t = np.clip(t, 0, T)
        done = np.where(
            t < r,
            a * t * t / 2,
            np.where(t > T - r, largest[index] - a * (T - t) ** 2 / 2, cruise[index] * (t - r / 2)),
        )
        return points[index] + (done / largest[index])[:, None] * steps[index]

    return sample_motion(at, float(ends[-1]), points[-1], dt)


def sample_motion(motion: Callable[[Array], Array], duration: float, goal: Array, dt: float) -> Trajectory:
    """Sample a motion at a whole number of time steps ``dt``, slowed down if necessary.

    Args:
        motion: function from times (T,) s to configurations (T, n).
        duration: duration of the motion, s.
        goal: (n,) last configuration, which replaces the last row.
        dt: time between rows, s.
    """
    count = max(1, int(np.ceil(duration / dt - 1e-9)))
    qpos = np.array(motion(np.arange(1, count + 1, dtype=np.float64) * (duration / count)), dtype=np.float64)
    qpos[-1] = goal
    return Trajectory(qpos, dt)
