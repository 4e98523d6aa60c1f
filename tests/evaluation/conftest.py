from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from counting_env import CountingEnv

from robocas_ms3.evaluation import session
from robocas_ms3.evaluation.protocol import load_protocol


@pytest.fixture
def made(monkeypatch) -> list[CountingEnv]:
    """Environments without physics; those that were made, in order."""
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
    folder = tmp_path_factory.mktemp("protocols") / "short"
    shutil.copytree(load_protocol("smoke").folder, folder)
    rules = folder / "protocol.yaml"
    rules.write_text(rules.read_text().replace("max_steps: null", "max_steps: 20"))
    return folder
