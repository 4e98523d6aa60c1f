"""A fourth camera (YAML) and new recorded quantities (one entry each) work in all readers and writers of data."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
from example_packages import ROOT

# runs when Python starts, also in workers; in the package, these are entries of the list
ENTRY = """
from robocas_ms3.robots import quantities

quantities.QUANTITIES = (
    quantities.Quantity(
        "yaw", "float32", ("T",), "rad", "of the base, in its root",
        record=lambda motion: motion.qpos[:, 2],
        lerobot_feature="observation.state",
    ),
    *quantities.QUANTITIES,
    quantities.Quantity(
        "fingers", "float32", ("T", 2), "m", "positions of both fingers",
        observe=lambda agent: agent.robot.get_qpos()[:, 10:],
        policy_key="fingers",
        record=lambda motion: motion.qpos[:, 10:],
        lerobot_feature="observation.fingers",
    ),
    quantities.Quantity(
        "gap", "float32", ("T",), "m", "between the fingers",
        record=lambda motion: motion.qpos[:, 10:].sum(axis=1),
        optional=True,
    ),
)
"""
CONFIG = """
extends: pick_table_scattered
cameras:
  base_camera: {width: 64, height: 48}
  gripper_camera: {width: 64, height: 48}
  static_camera: {width: 64, height: 48}
  side_camera: {position: [1.2, -0.6, 1.3], look_at: [1.2, 0.7, 0.6], width: 80, height: 64}
"""
PLAN = """
rules: {name: tiny, description: Two seconds., max_seconds: {pick: 2}}
parts: [{config: CONFIG, count: 1, first_seed: 110000}]
"""
POLICY = """
import numpy as np
from robocas_ms3.evaluation.policy import PolicySpec
from robocas_ms3.evaluation.remote.messages import make_observation_message, parse_observations

class Sees:
    spec = PolicySpec(rate_hz=5, cameras={"side_camera": (32, 24)}, language="none")

    def reset(self, episodes):
        pass

    def act(self, seen):
        assert seen.images["side_camera"].shape == (1, 24, 32, 3) and seen.images["side_camera"].std() > 10
        assert np.allclose(seen.fingers, seen.qpos[:, 10:])
        again = parse_observations([make_observation_message(seen, 0, None, reset=False)], [0], self.spec)
        assert np.array_equal(again.fingers, seen.fingers)
        return np.zeros((1, 7))
"""
STEPS = """
import shutil
import sys
from pathlib import Path

import numpy as np

from robocas_ms3.cli.main import run
from robocas_ms3.datasets import RoboCASDataset, SampleOptions
from robocas_ms3.datasets.formats import open_source

CAMERAS = ("base_camera", "gripper_camera", "static_camera", "side_camera")


def main():
    for words in (
        "generate pick -n 1 --seed 5 --config four_cameras.yaml --out demos --check-trials 0 --check-rate 0",
        "convert demos/trajectory.h5 --out robocas --no-embeddings --no-video",
        "convert robocas --to lerobot --out lerobot",
        "validate robocas",
        "validate lerobot",
        "eval freeze plan.yaml --out tiny",
        "eval --policy sees:Sees --protocol tiny --out result --backend processes --envs 1",
    ):
        assert run(words.split()) == 0, words
    older = Path(shutil.copytree("robocas", "older")) / "episode_0000000" / "episode_info.npz"  # without `gap`
    arrays = dict(np.load(older))
    assert arrays.pop("gap").max() > 0.03
    np.savez(older, **arrays)
    for words in (
        "validate older",
        "merge older --out merged",
        "convert older --to lerobot --out from_older",
        "convert lerobot --to lerobot --out again",  # LeRobot holds no gap
        "validate again",
    ):
        assert run(words.split()) == 0, words
    sources = [open_source(Path(name)) for name in ("demos/trajectory.h5", "robocas", "lerobot")]
    arrays = [source.episode(0).arrays["fingers"] for source in sources]
    assert np.array_equal(sources[2].episode(0).arrays["yaw"], sources[0].episode(0).arrays["yaw"])
    assert arrays[0].shape == (sources[0].lengths[0], 2) and arrays[0].max() > 0.03
    for source, fingers in zip(sources[1:], arrays[1:]):
        assert source.cameras == CAMERAS and np.array_equal(fingers, arrays[0])
        episode, place = source.episode(0), source.episode(0).camera("side_camera")
        assert place.parent == "world" and np.allclose(place.camera_in_parent[:3, 3], [1.2, -0.6, 1.3])
        assert np.allclose(place.intrinsic, [32, 32, 40, 32])
        assert episode.rgb("side_camera", 3).shape == (64, 80, 3) and episode.rgb("base_camera", 3).shape == (48, 64, 3)
        assert episode.rgb("side_camera", 3).std() > 10
        options = SampleOptions("all", 2, cameras=CAMERAS[2:], size=(32, 24), state=("ee_pos", "fingers"))
        sample = RoboCASDataset(source.root, options)[5]
        assert sample["rgb"].shape == (2, 2, 3, 24, 32) and sample["state"].shape == (2, 5)
        assert np.array_equal(sample["state"][:, 3:], fingers[4:6])


if __name__ == "__main__":
    main()
"""


@pytest.mark.slow
def test_generate_convert_read_and_evaluate(tmp_path, needs_renderer):
    files = {"sitecustomize.py": ENTRY, "sees.py": POLICY, "steps.py": STEPS, "four_cameras.yaml": CONFIG}
    for name, text in {**files, "plan.yaml": PLAN.replace("CONFIG", str(tmp_path / "four_cameras.yaml"))}.items():
        (tmp_path / name).write_text(text)
    env = os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)])}
    command = [sys.executable, "steps.py"]
    done = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
