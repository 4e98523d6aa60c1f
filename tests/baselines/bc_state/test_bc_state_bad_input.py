"""What `bc-state` can't learn from, and what it can't act in: a line each, and nothing kept of it."""

from types import SimpleNamespace

import numpy as np
import pytest
from synthetic import write_trajectory

from robocas_ms3.baselines.bc_state import BASELINE, data
from robocas_ms3.baselines.bc_state.config import BcStateConfig
from robocas_ms3.baselines.bc_state.data import StateSamples
from robocas_ms3.core.errors import DatasetError, EvaluationError
from robocas_ms3.demos.recordings.environment import RecordedEnv
from robocas_ms3.evaluation.policy import EpisodeSpec, Observations


@pytest.fixture
def telling(monkeypatch, tmp_path):
    """Lets a made-up simulator say given rows, one after the other, the last for good."""
    monkeypatch.setenv("ROBOCAS_CACHE", str(tmp_path / "cache"))
    env = SimpleNamespace(reset=lambda **_: None, close=lambda: None, unwrapped=None)
    monkeypatch.setattr(RecordedEnv, "make", lambda self, **_: env)

    def say(*rows):
        rest = list(rows)
        monkeypatch.setattr(data, "_row", lambda env, state: np.array(rest.pop(0) if len(rest) > 1 else rest[0]))

    return say


def refused(path):
    with pytest.raises(DatasetError) as caught:
        StateSamples(BcStateConfig(), path, "train")
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)
    return str(caught.value)


def test_a_made_up_simulator_is_heard(telling, tmp_path):
    telling([1.0, 2.0, 3.0])
    samples = StateSamples(BcStateConfig(), write_trajectory(tmp_path / "F.h5"), "train")
    assert samples.episodes == 2 and len(samples.facts["inputs"]["mean"]) == 3 + 10


@pytest.mark.parametrize("rows", [([1.0, np.nan],), ([1.0, 2.0], [np.inf, 2.0], [1.0, 2.0])])
def test_what_is_no_number(telling, tmp_path, rows):
    telling(*rows)
    assert "told: not a number" in refused(write_trajectory(tmp_path / "F.h5"))
    assert not (tmp_path / "cache" / "bc-state").exists()


def test_scenes_that_hold_other_things(telling, tmp_path):
    path = write_trajectory(tmp_path / "F.h5")
    telling(*[[1.0, 2.0]] * 7, [1.0, 2.0, 3.0])  # as many rows as are sampled of the first episode
    said = refused(path)
    assert "episode 1: other things stand in this scene (expected 2, found 3)" in said


def test_no_success(telling, tmp_path):
    telling([1.0])
    assert "no successful episodes" in refused(write_trajectory(tmp_path / "F.h5", seeds=(3,), failed=(0,)))


@pytest.mark.parametrize("name", ["", "data_info.json"])
def test_what_is_no_trajectory(tmp_path, name):
    said = refused(tmp_path / name if name else tmp_path)
    assert "bc-state learns from recorded states" in said and "Name the trajectory.h5" in said


def test_other_scenes_in_play():
    facts = {
        "rate_hz": 5.0,
        "inputs": {"mean": [0.0] * 13, "deviation": [1.0] * 13},
        "chunk": {"mean": [0.0] * 9, "deviation": [1.0] * 9},
        "keys": {"mean": [0.0] * 9, "deviation": [1.0] * 9},
    }
    config = BcStateConfig(width=8, blocks=1)
    policy = BASELINE.policy(config, facts, BASELINE.model(config, facts).eval())
    policy.reset([EpisodeSpec(0, 0, "pick", "", "", "builtin", 0, "")])
    seen = Observations(
        envs=np.array([0]),
        instructions=[""],
        embeddings=None,
        images={},
        depths={},
        qpos=np.zeros((1, 12), np.float32),
        tcp_in_base=np.array([[0.4, 0, 0.3, 1, 0, 0, 0]]),
        gripper_width=np.array([[0.08]]),
        state=np.zeros((1, 5)),
    )
    with pytest.raises(EvaluationError, match="expected 13 numbers, found 15"):
        policy.act(seen)
