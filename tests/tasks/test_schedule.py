"""Which envs are due, as it is counted on the host."""

import numpy as np
import pytest

from robocas_ms3.tasks.schedule import PeriodicSchedule


@pytest.fixture
def schedule() -> PeriodicSchedule:
    return PeriodicSchedule(4, 3, "cpu")


def test_every_env_is_due_before_its_first_step_and_every_period_after(schedule):
    found = []
    for _ in range(7):
        found.append(schedule.due().tolist())
        schedule.advance()
    assert found == [[0, 1, 2, 3], [], [], [0, 1, 2, 3], [], [], [0, 1, 2, 3]]


def test_an_env_counts_from_its_own_reset(schedule):
    schedule.advance()
    schedule.reset(np.array([1, 2]))
    found = []
    for _ in range(4):
        found.append(schedule.due().tolist())
        schedule.advance()
    assert found == [[1, 2], [], [0, 3], [1, 2]]


def test_envs_that_are_due_in_every_step_are_so_until_their_reset(schedule):
    schedule.advance()
    schedule.every_step(np.array([3]))
    found = []
    for _ in range(3):
        found.append(schedule.due().tolist())
        schedule.advance()
    assert found == [[3], [3], [0, 1, 2, 3]]
    schedule.reset(np.array([3]))
    schedule.advance()
    assert schedule.due().tolist() == []
