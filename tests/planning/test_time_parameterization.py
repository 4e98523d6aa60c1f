"""Time steps, limits, and the shape of rounded corners."""

from __future__ import annotations

import numpy as np
import pytest

from robocas_ms3.planning.time_parameterization import (
    fit_spline,
    round_corners,
    sample_motion,
    time_path,
    time_with_stops,
)

LIMITS = {"velocity": 0.5, "acceleration": 0.5}


def derivatives(start, trajectory):
    rows = np.vstack([start, start, trajectory.qpos, trajectory.qpos[-1]])
    velocity = np.diff(rows, axis=0) / trajectory.dt
    return velocity, np.diff(velocity, axis=0) / trajectory.dt


def test_straight_motion_has_a_trapezoidal_velocity_profile():
    # 1 rad at 0.98 x (0.5 rad/s, 0.5 rad/s2): 1 s to speed up, 1 s to slow down, 0.51 rad left at 0.49 rad/s.
    trajectory = time_with_stops(np.array([[0.0, 0.0], [1.0, -0.5]]), dt=0.01, **LIMITS)
    expected = 2 * 1.0 + (1.0 - 0.49) / 0.49
    assert len(trajectory.qpos) == int(np.ceil(expected / 0.01))
    np.testing.assert_allclose(trajectory.qpos[:, 1], -0.5 * trajectory.qpos[:, 0], atol=1e-12)
    velocity, acceleration = derivatives([0, 0], trajectory)
    assert 0.485 < np.abs(velocity).max() <= 0.5
    assert np.abs(acceleration).max() <= 0.5


def test_short_straight_motion_does_not_reach_the_maximum_velocity():
    # 0.01 rad: peak sqrt(0.01 x 0.49) = 0.07 rad/s, 2 x 0.07 / 0.49 = 0.2857 s: 6 steps of 0.05 s.
    trajectory = time_with_stops(np.array([[0.0], [0.01]]), dt=0.05, **LIMITS)
    assert len(trajectory.qpos) == 6
    assert trajectory.qpos[-1, 0] == 0.01
    assert 0.0049 < trajectory.qpos[2, 0] < 0.0051  # half way in the middle


@pytest.mark.parametrize("duration", [0.001, 0.05, 0.0500001, 0.149, 1.0])
def test_rows_are_at_multiples_of_the_time_step_and_end_at_the_goal(duration):
    goal = np.array([1.0 + 1e-7])
    trajectory = sample_motion(lambda t: (t / duration)[:, None], duration, goal, 0.05)
    count = len(trajectory.qpos)
    assert count == max(1, int(np.ceil(duration / 0.05 - 1e-9)))
    np.testing.assert_allclose(trajectory.qpos[:-1, 0], np.arange(1, count) / count)
    assert trajectory.qpos[-1] == goal
    assert trajectory.duration == pytest.approx(count * 0.05)


def test_rounded_corner_is_a_parabola_inside_the_corner():
    path = round_corners(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]), 0.2)
    # Straight 0.8, bend from (0.8, 0) to (1, 0.2), straight 0.8; the bend's parameter is as long as the corner's legs.
    assert path.length == pytest.approx(0.8 + 0.4 + 0.8)
    np.testing.assert_allclose(path(np.array([0.0, 0.8, 1.2, 2.0])), [[0, 0], [0.8, 0], [1, 0.2], [1, 1]], atol=1e-12)
    np.testing.assert_allclose(path(np.array([1.0])), [[0.95, 0.05]], atol=1e-12)  # Bezier of the three points
    np.testing.assert_allclose(path(np.array([0.8, 1.0, 1.2]), 1), [[1, 0], [0.5, 0.5], [0, 1]], atol=1e-12)


def test_rounded_corners_do_not_overlap():
    path = round_corners(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 0.1], [2.0, 0.1]]), 0.3)
    dense = path.sample(0.001)
    assert np.abs(np.diff(dense, axis=0)).max() <= 0.001 + 1e-9
    np.testing.assert_allclose(dense[[0, -1]], [[0, 0], [2, 0.1]], atol=1e-12)
    assert dense[:, 1].min() >= -1e-12 and dense[:, 1].max() <= 0.1 + 1e-12


@pytest.mark.parametrize("seed", range(4))
def test_timed_paths_respect_the_limits_and_end_at_rest(seed):
    points = np.random.default_rng(seed).uniform(-1, 1, (5, 7))
    trajectory = time_path(round_corners(points, 0.3), dt=0.01, **LIMITS)
    assert trajectory is not None
    velocity, acceleration = derivatives(points[0], trajectory)
    assert np.abs(velocity).max() <= 0.5 + 1e-3
    assert np.abs(velocity).max() >= 0.4  # not needlessly slow
    assert np.abs(acceleration).max() <= 0.5 * 1.05
    np.testing.assert_array_equal(trajectory.qpos[-1], points[-1])


def test_spline_through_a_smooth_motion_stays_on_it():
    angle = np.linspace(0, 1, 15)
    path = fit_spline(np.stack([np.sin(angle), np.cos(angle)], axis=1))
    np.testing.assert_allclose(np.linalg.norm(path.sample(0.001), axis=1), 1.0, atol=1e-6)
    trajectory = time_path(path, dt=0.05, **LIMITS)
    assert trajectory is not None
    np.testing.assert_array_equal(trajectory.qpos[-1], [np.sin(1.0), np.cos(1.0)])
