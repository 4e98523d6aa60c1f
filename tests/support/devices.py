"""Interrupt and continue a training on a device with a precision, and run its policy."""

import json

import numpy as np
import pytest
from rt1_sizes import SIZES
from synthetic_observations import observe, start
from training_runs import stop_at, train

from robocas_ms3.baselines.policy import RunPolicy

VIEW = {"image_size": [64, 48], "size": [64, 48]}
CHANGES = {
    "small": {"views": {"base_camera": VIEW, "gripper_camera": VIEW}, "channels": 8, "width": 32, "heads": 2},
    "rt1": SIZES,
}
TRAIN = {"steps": 6, "batch_size": 2, "log_every": 2, "validate_every": 3, "save_every": 2, "workers": 0}


def check(dataset, tmp_path, name, precision, device):
    out = tmp_path / "run"
    changes = {**CHANGES[name], "train": {**TRAIN, "precision": precision}}
    with pytest.raises(KeyboardInterrupt):
        train(name, dataset, out, changes, device=device, progress=stop_at(3, KeyboardInterrupt()))
    record = train(name, dataset, out, device=device)
    assert (record.device, record.hardware_changes) == (device, [])
    rows = (out / "metrics.csv").read_text().splitlines()
    assert [row.split(",")[:2] for row in rows[1:]] == [
        [step, split] for step, split in (("2", "train"), ("3", "val"), ("4", "train"), ("6", "train"), ("6", "val"))
    ]
    policy = RunPolicy(out, device)
    policy.reset([start(0), start(1)])
    sizes = policy.spec.cameras.items()
    images = {camera: np.zeros((2, height, width, 3), np.uint8) for camera, (width, height) in sizes}
    seen = observe((0, 1), embeddings=np.ones((2, 384), np.float32), images=images)
    acted = policy.act(seen)
    assert acted.shape == (2, 7) and np.isfinite(acted).all()
    assert np.array_equal(acted[0], acted[1])
    assert json.loads((out / "run.json").read_text())["precision"] == ("bf16" if precision == "bf16" else "no")
