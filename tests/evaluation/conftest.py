from __future__ import annotations

from pathlib import Path

import pytest
from counting_env import CountingEnv

from robocas_ms3.evaluation import session


@pytest.fixture
def made(monkeypatch) -> list[CountingEnv]:
    """Environments without physics; those that were made, in order."""
    envs: list[CountingEnv] = []

    def make_vec(env_id, num_envs, *, backend, config, **others):
        assert backend in ("processes", "auto")
        envs.append(CountingEnv(Path(config).stem, num_envs))
        return envs[-1]

    monkeypatch.setattr(session, "make_vec", make_vec)
    return envs
