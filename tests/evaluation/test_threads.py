"""Torch's threads: evaluation leaves those of a user's process alone; its command takes one."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from robocas_ms3.cli.main import run
from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.evaluation import session
from robocas_ms3.evaluation.policy import ExternalPolicy, PolicySpec
from robocas_ms3.evaluation.protocol import load_protocol
from robocas_ms3.evaluation.settings import EvaluationSettings


@pytest.fixture(autouse=True)
def two_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def test_who_makes_the_envs_keeps_them(monkeypatch):
    asked = []
    monkeypatch.setattr(session, "make_vec", lambda *args, **kwargs: asked.append(args) or SimpleNamespace(num_envs=2))
    protocol, settings = load_protocol("smoke"), EvaluationSettings(backend="processes")
    session.EvaluationSession(protocol, ExternalPolicy(PolicySpec()), settings).open(protocol.episodes[0], 2)
    assert asked == [("RoboCASPick-v1", 2)]
    assert torch.get_num_threads() == 2


def test_the_command_takes_one(monkeypatch, tmp_path):
    seen = []

    def evaluate(*args, **kwargs):
        seen.append(torch.get_num_threads())
        raise EvaluationError("enough")

    monkeypatch.setattr("robocas_ms3.evaluation.session.evaluate", evaluate)
    words = ["eval", "--protocol", "smoke", "--policy", "still", "--out", str(tmp_path / "out")]
    assert (run(words), seen) == (1, [1])
