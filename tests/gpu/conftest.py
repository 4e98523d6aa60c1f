"""Batches on the emulated GPU interface, and single envs to compare them with."""

from __future__ import annotations

from collections.abc import Iterator

import gymnasium as gym
import pytest
from batches import make_batch, make_singles
from gpu_emulation import emulated_envs

from robocas_ms3.tasks import TASKS


@pytest.fixture(scope="module", params=sorted(TASKS))
def task(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture(scope="module")
def batch_and_singles(task: str) -> Iterator[tuple[gym.Env, list[gym.Env]]]:
    """A batch and single envs, to make the same steps with."""
    batch, singles = make_batch(task, emulated_envs()), make_singles(task, emulated_envs())
    yield batch, singles
    for env in (batch, *singles):
        env.close()
