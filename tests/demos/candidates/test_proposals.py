"""Random candidates: the start of a push, by hand."""

import numpy as np
import pytest

from robocas_ms3.demos.candidates.proposals import PUSH_SHIFT, draw_push_start
from robocas_ms3.planning.pushes import STAND_OFF, TOOL_RADIUS

RADIUS, MIDDLE, LOWEST = 0.05, np.array([0.5, 0.1, 0.2]), 0.15


@pytest.fixture
def cylinder():
    """Return points on a cylinder of 10 cm height around ``MIDDLE``."""
    angles, heights = np.meshgrid(np.linspace(0, 2 * np.pi, 360, endpoint=False), np.linspace(-0.05, 0.05, 11))
    columns = [RADIUS * np.cos(angles), RADIUS * np.sin(angles), heights]
    return MIDDLE + np.stack(columns, axis=-1).reshape(-1, 3)


@pytest.mark.parametrize("near_miss", [False, True])
def test_push_starts_behind_the_object_and_near_misses_pass_beside_its_middle(cylinder, near_miss):
    rng = np.random.default_rng(0)
    angles = []
    for _ in range(100):
        tool, direction = draw_push_start(rng, cylinder, LOWEST, near_miss)
        assert np.linalg.norm(direction) == pytest.approx(1)
        assert direction[2] == 0
        offset = (MIDDLE - tool)[:2]
        assert offset @ direction[:2] == pytest.approx(RADIUS + STAND_OFF + TOOL_RADIUS, abs=1e-4)
        aside = abs(offset @ [-direction[1], direction[0]])
        assert PUSH_SHIFT[0] <= aside <= PUSH_SHIFT[1] if near_miss else aside == pytest.approx(0, abs=1e-9)
        assert LOWEST <= tool[2] <= MIDDLE[2] + 0.05
        angles.append(np.arctan2(direction[1], direction[0]))
    counts, _ = np.histogram(angles, bins=4, range=(-np.pi, np.pi))
    assert counts.min() > 10  # in all directions


def test_push_of_a_flat_object_keeps_above_the_surface(cylinder):
    flat = cylinder * [1, 1, 0] + [0, 0, LOWEST - 0.01]
    tool, _ = draw_push_start(np.random.default_rng(0), flat, LOWEST, False)
    assert tool[2] == pytest.approx(LOWEST)


def test_push_of_a_flat_object_on_a_heap_is_not_below_it(cylinder):
    bottom, flat = LOWEST + 0.1, cylinder * [1, 1, 0.05] + [0, 0, LOWEST + 0.1 - 0.05 * 0.15]  # 5 mm high
    tool, _ = draw_push_start(np.random.default_rng(0), flat, LOWEST, False)
    assert tool[2] == pytest.approx(bottom, abs=1e-6)
