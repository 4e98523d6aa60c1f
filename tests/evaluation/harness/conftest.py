from __future__ import annotations

import pytest
from counting_env import CountingEnv

from robocas_ms3.evaluation.harness import driven


@pytest.fixture
def made(monkeypatch) -> list[CountingEnv]:
    """Environments without physics; those that were made, in order."""
    envs: list[CountingEnv] = []

    def make_env(protocol, spec, episode, num_envs, *, backend, **others):
        assert backend in ("processes", "auto")
        envs.append(CountingEnv(episode.config, num_envs))
        return envs[-1]

    monkeypatch.setattr(driven, "make_env", make_env)
    return envs
