"""PPO in a stub environment: learning, interruption and continuation; one short run in the simulator."""

from dataclasses import replace

import pytest
import torch
from safetensors.torch import load_file
from stub_envs import LeftOrRight, StubEnvironments
from training_runs import read_log, stop_at, train

from robocas_ms3.baselines.policy import RunPolicy
from robocas_ms3.baselines.ppo import BASELINE
from robocas_ms3.baselines.registry import BASELINES
from robocas_ms3.baselines.training.session import ProgressCallbacks
from robocas_ms3.core.errors import OutputExistsError, TrainingError

SMALL = {"width": 16, "envs": 4, "test_episodes": 20, "layouts": 10, "train": {"steps": 1280, "batch_size": 64}}


@pytest.fixture
def stub(monkeypatch):
    monkeypatch.setitem(BASELINES.builtin, "ppo", lambda: replace(BASELINE, environments=StubEnvironments))
    monkeypatch.setattr(StubEnvironments, "made", [])


def test_agent_learns(stub, tmp_path):
    record = train("ppo", None, tmp_path / "run", SMALL)
    assert (record.data.name, record.data.hash, record.data.episodes) == ("left or right", "1234", 10)
    rows = read_log(tmp_path / "run", "train")
    assert [int(row["step"]) for row in rows] == list(range(64, 1281, 64))
    assert abs(float(rows[0]["return"])) < 1.5
    (tried,) = read_log(tmp_path / "run", "val")
    assert float(tried["return"]) > 2
    assert RunPolicy(tmp_path / "run").describe()["steps"] == 1280


def test_run_continues_after_ctrl_c(stub, tmp_path):
    run = tmp_path / "run"
    with pytest.raises(KeyboardInterrupt):
        train("ppo", None, run, SMALL, progress=stop_at(640, KeyboardInterrupt()))
    kept, weights = load_file(run / "checkpoint.safetensors"), load_file(run / "weights.safetensors")
    assert not read_log(run, "val")
    assert weights["count"].item() == pytest.approx(640, abs=1e-3)
    assert int(kept["episodes.count"]) == 640 // LeftOrRight.STEPS
    with pytest.raises(KeyboardInterrupt):
        train("ppo", None, run, progress=stop_at(640, KeyboardInterrupt()))  # before the next update
    again, steps = load_file(run / "checkpoint.safetensors"), []
    assert kept.keys() == again.keys() and any(name.startswith("optimizer.") for name in kept)
    assert all(torch.equal(kept[name], again[name]) for name in kept)
    train("ppo", None, run, progress=ProgressCallbacks(on_step=lambda done, of: steps.append(done)))
    assert steps == list(range(640, 1281, 64))
    assert [int(row["step"]) for row in read_log(run, "train")] == list(range(64, 1281, 64))
    assert load_file(run / "weights.safetensors")["count"].item() == pytest.approx(1280, abs=1e-3)
    first, second = (StubEnvironments.made[number].seeds[0] for number in (0, -1))
    assert (first, second) == (0, 640 // LeftOrRight.STEPS % 10)  # the layouts after those already used
    before = (run / "weights.safetensors").read_bytes()
    train("ppo", None, run)  # a finished run does nothing
    assert (run / "weights.safetensors").read_bytes() == before
    assert len(read_log(run, "val")) == 1


def test_a_nan_gradient_is_not_saved(stub, monkeypatch, tmp_path):
    """A NaN gradient is also found in the last step of an update, whose losses are finite."""
    clip, calls = torch.nn.utils.clip_grad_norm_, []

    def spoil(parameters, most):
        parameters = list(parameters)
        calls.append(len(parameters))
        if len(calls) == 2 * 10 * 4:  # updates, epochs, minibatches: the last minibatch
            parameters[0].grad.fill_(torch.nan)
        return clip(parameters, most)

    monkeypatch.setattr(torch.nn.utils, "clip_grad_norm_", spoil)
    changes = {**SMALL, "train": {"steps": 128, "batch_size": 64, "save_every": 64}}
    with pytest.raises(TrainingError, match="gradient"):
        train("ppo", None, tmp_path / "run", changes)
    saved = load_file(tmp_path / "run" / "checkpoint.safetensors")
    assert all(tensor.isfinite().all() for tensor in saved.values())


def test_data_is_refused(stub, tmp_path):
    with pytest.raises(TrainingError) as caught:
        train("ppo", tmp_path, tmp_path / "run", SMALL)
    assert caught.value.where == "--data"
    with pytest.raises(TrainingError) as caught:
        train("small", None, tmp_path / "run")
    assert caught.value.where == "--data"


def test_run_with_other_scenes_is_not_continued(stub, monkeypatch, tmp_path):
    train("ppo", None, tmp_path / "run", SMALL | {"test_episodes": 0, "train": {"steps": 64, "batch_size": 64}})
    monkeypatch.setattr(StubEnvironments, "hash", "5678")
    with pytest.raises(OutputExistsError):
        train("ppo", None, tmp_path / "run")


@pytest.mark.slow
def test_a_short_run_in_the_simulator(tmp_path):
    run = tmp_path / "run"
    small = {
        "envs": 2,
        "workers": 1,
        "layouts": 2,
        "test_episodes": 2,
        "epochs": 1,
        "train": {"steps": 128, "batch_size": 64},
    }
    train("ppo", None, run, small)
    rows = read_log(run, "train")
    assert [row["step"] for row in rows] == ["64", "128"]
    assert 0 < float(rows[-1]["return"]) < 20
    assert RunPolicy(run).spec.state
