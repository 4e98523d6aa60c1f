"""End-to-end: generate, convert, train, eval."""

import json

import numpy as np
import pytest

from robocas_ms3.baselines.bc_state import BASELINE, BcStateConfig
from robocas_ms3.cli.main import run

SEED = 510_000
VIEW = "{image_size: [64, 48], size: [64, 48]}"
TINY = ["--set", f"views.base_camera={VIEW}", "--set", "width=32", "--set", "channels=8"]
TINY += ["--set", f"views.gripper_camera={VIEW}", "--set", "heads=2", "--set", "layers=1"]


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    """Return two episodes in the scenes of paper-v1; one is the validation split."""
    out = tmp_path_factory.mktemp("demos") / "pick"
    words = ["generate", "pick", "--config", "pick_upstream_eval", "-n", "2", "--seed", str(SEED), "--out", str(out)]
    assert run([*words, "--check-rate", "0"]) == 0
    return out / "trajectory.h5"


def read_outcomes(folder):
    return [json.loads(line) for line in (folder / "episodes.jsonl").read_text().splitlines()]


@pytest.mark.slow
def test_bc_state(demos, tmp_path, monkeypatch):
    monkeypatch.setenv("ROBOCAS_CACHE", str(tmp_path / "cache"))
    words = ["train", "bc-state", "--data", str(demos), "--out", str(tmp_path / "run"), "--set", "width=16"]
    assert run([*words, "--steps", "5", "--set", "blocks=1"]) == 0
    assert len(list((tmp_path / "cache" / "bc-state").iterdir())) == 1
    words = ["eval", "pick", "--policy", str(tmp_path / "run"), "--protocol", "paper-v1", "--episodes", "1"]
    assert run([*words, "--out", str(tmp_path / "eval"), "--envs", "1"]) == 0
    [outcome] = read_outcomes(tmp_path / "eval")
    assert outcome["error"] == "" and outcome["steps"] > 0
    said = json.loads((tmp_path / "eval" / "run.json").read_text())["policy"]
    assert (said["baseline"], said["steps"], said["spec"]["state"]) == ("bc-state", 5, True)

    samples = BASELINE.data(BcStateConfig(), demos, "train", lambda done, total: None)
    batch = samples.__getitems__(list(range(len(samples))))
    to_target = batch["inputs"][
        :, -19:-16
    ].numpy()  # tcp_to_target; after it 3 values to the goal, 3 extents, 10 of the arm
    assert np.linalg.norm(to_target[0]) > 0.1  # it starts away from the target,
    assert np.linalg.norm(to_target, axis=1).min() < 0.03  # and grasps it


@pytest.mark.slow
def test_small(demos, short, tmp_path, needs_renderer):
    words = ["convert", str(demos), "--out", str(tmp_path / "data"), "--size", "64", "48", "--no-depth", "--no-video"]
    assert run([*words, "--cameras", "base_camera", "gripper_camera"]) == 0
    words = ["train", "small", "--data", str(tmp_path / "data"), "--out", str(tmp_path / "run"), "--steps", "3", *TINY]
    assert run(words) == 0
    words = ["eval", "pick", "--policy", str(tmp_path / "run"), "--protocol", short, "--episodes", "1"]
    assert run([*words, "--out", str(tmp_path / "eval"), "--envs", "1"]) == 0
    [outcome] = read_outcomes(tmp_path / "eval")
    assert outcome["error"] == "" and outcome["steps"] > 0
