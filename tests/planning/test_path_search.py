"""Path search in a plane with a wall."""

from __future__ import annotations

import numpy as np

from robocas_ms3.planning.path_search import PathSearch

LOW, HIGH = np.array([-2.0, -2.0]), np.array([2.0, 2.0])
START, GOAL = np.array([-1.0, 0.0]), np.array([1.0, 0.0])


def off_the_wall(q):
    """Return whether a point is outside of a wall at |x| < 0.1 with a gap at 1.5 < y < 1.8."""
    return abs(q[0]) >= 0.1 or 1.5 < q[1] < 1.8


def search(valid=off_the_wall, spacing=0.02):
    def count_leading_free(path):
        return next((i for i, q in enumerate(path) if not valid(q)), len(path))

    return PathSearch(count_leading_free, LOW, HIGH, step=0.2, spacing=spacing)


def length(path):
    return np.linalg.norm(np.diff(path, axis=0), axis=1).sum()


def test_path_passes_the_gap_and_is_collision_free():
    path = search().connect(START, [GOAL], np.random.default_rng(0), max_checks=20000)
    assert path is not None
    np.testing.assert_array_equal(path[0], START)
    np.testing.assert_array_equal(path[-1], GOAL)
    dense = np.concatenate([np.linspace(a, b, 50) for a, b in zip(path[:-1], path[1:], strict=True)])
    assert all(map(off_the_wall, dense))
    assert any(abs(q[0]) < 0.1 and 1.5 < q[1] < 1.8 for q in dense)


def test_shortened_path_keeps_its_ends_and_is_nearly_optimal():
    finder, rng = search(), np.random.default_rng(1)
    path = finder.connect(START, [GOAL], rng, max_checks=20000)
    assert path is not None
    short = finder.shorten(path, rng, tries=200, max_checks=50000)
    shortest = 2 * np.hypot(0.9, 1.5) + 0.2
    assert shortest - 1e-6 <= length(short) <= 1.1 * shortest
    assert length(short) <= length(path)
    np.testing.assert_array_equal(short[0], START)
    np.testing.assert_array_equal(short[-1], GOAL)
