"""The bundled weights: small, of this version, and the policy `small` by name."""

import json
from pathlib import Path

import pytest

from robocas_ms3.baselines.policy import RunPolicy
from robocas_ms3.baselines.small import BASELINE
from robocas_ms3.baselines.training.record import BUNDLED, CHECKPOINT, read_run
from robocas_ms3.baselines.training.session import load_initial_weights
from robocas_ms3.cli.main import run
from robocas_ms3.core.errors import TrainingError
from robocas_ms3.evaluation.policies import make_policy


def test_they_are_small_and_of_this_version():
    record = read_run(BUNDLED / "small")
    assert (record.baseline, record.version) == ("small", BASELINE.version)
    assert sum(path.stat().st_size for path in BUNDLED.rglob("*")) < 10e6
    assert not (BUNDLED / "small" / CHECKPOINT).exists()


def test_they_are_a_policy_by_name():
    policy = make_policy("small")
    assert isinstance(policy, RunPolicy)
    assert (policy.spec.convention, policy.spec.rate_hz, policy.spec.language) == ("robocas", 5.0, "embedding")
    assert policy.describe()["steps"] > 0


def test_they_are_initial_weights_by_name(tmp_path, monkeypatch):
    """Also where a folder is called so, which a longer path names."""
    monkeypatch.chdir(tmp_path)
    initial = load_initial_weights(BASELINE, Path("small"), None, tmp_path / "out")
    assert initial is not None and initial.weights
    assert initial.record == read_run(BUNDLED / "small")
    Path("small").mkdir()
    again = load_initial_weights(BASELINE, Path("small"), None, tmp_path / "out")
    assert again is not None and again.name == initial.name
    with pytest.raises(TrainingError, match="no run of robocas train"):
        load_initial_weights(BASELINE, tmp_path / "small", None, tmp_path / "out")


@pytest.mark.slow
def test_they_reach_the_target(short, tmp_path, needs_renderer):
    """Of three objects one at least: which of them depends on how a processor rounds."""
    words = ["eval", "--policy", "small", "--protocol", short, "--envs", "2"]
    assert run([*words, "--out", str(tmp_path / "eval")]) == 0
    played = [json.loads(line) for line in (tmp_path / "eval" / "episodes.jsonl").read_text().splitlines()]
    assert len(played) == 3 and not any(one["error"] for one in played)
    assert any(one["flags"]["reached_target"] is not None for one in played)
