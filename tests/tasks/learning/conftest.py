"""What tests of rewards, fail and observations share."""

from __future__ import annotations

import gymnasium as gym
import pytest
from learning_envs import STATE_ONLY

import robocas_ms3  # noqa: F401


@pytest.fixture(scope="module")
def env():
    env = gym.make("RoboCASPick-v1", obs_mode="state_dict", reward_mode="normalized_dense", **STATE_ONLY)
    yield env
    env.close()
