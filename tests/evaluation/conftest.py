from __future__ import annotations

from pathlib import Path

import pytest
from counting_env import CountingEnv
from short_protocols import shorten

from robocas_ms3.evaluation.rollouts import session


@pytest.fixture
def made(monkeypatch) -> list[CountingEnv]:
    """Replace environments by environments without physics; return the created environments in order."""
    envs: list[CountingEnv] = []

    def make_vec(env_id, num_envs, *, config, **others):
        envs.append(CountingEnv(num_envs, config=Path(config).stem))
        return envs[-1]

    monkeypatch.setattr(session, "make_vec", make_vec)
    monkeypatch.setattr(session, "require_renderer", lambda: None)
    return envs


@pytest.fixture(scope="session")
def short(tmp_path_factory) -> Path:
    """The protocol smoke with 20 steps per episode."""
    return shorten("smoke", tmp_path_factory.mktemp("protocols") / "short", 20)
