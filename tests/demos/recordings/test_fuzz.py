"""Whatever a file of a recording holds: it is read, or refused by one of our errors."""

import json
from contextlib import suppress

import numpy as np
import pytest
from fuzzing import flipped, twist_file
from synthetic import write_trajectory

from robocas_ms3.core.errors import RobocasError
from robocas_ms3.demos.recordings.reading import TrajectoryFile
from robocas_ms3.demos.replay import Recorded


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = write_trajectory(tmp_path_factory.mktemp("whole") / "trajectory.h5")
    return path.read_bytes(), json.loads(path.with_suffix(".json").read_text())


def read_all(path):
    """Everything that a conversion and a replay read."""
    with TrajectoryFile(path) as file:
        for index in range(len(file.episodes)):
            recording = file.recording(index)
            motion = recording.motion(np.arange(0, recording.control_steps + 1, 4))
            assert np.isfinite(motion.actions).all()
            assert np.isfinite(Recorded.read(path, file.episodes[index]).actions).all()


def test_bytes_of_the_hdf5(whole, tmp_path):
    path = tmp_path / "trajectory.h5"
    path.with_suffix(".json").write_text(json.dumps(whole[1]))
    refused = 0
    for seed in range(120):
        path.write_bytes(flipped(whole[0], seed))
        try:
            read_all(path)
        except RobocasError as error:
            refused += 1
            assert "\n" not in str(error)
    assert refused > 20


def test_values_of_the_json(whole, tmp_path):
    path = tmp_path / "trajectory.h5"
    path.write_bytes(whole[0])
    refused = 0
    for seed in range(300):
        said = twist_file(path.with_suffix(".json"), whole[1], seed)
        try:
            with suppress(RobocasError):
                read_all(path)
                continue
            refused += 1
        except Exception as error:
            raise AssertionError(f"seed {seed}: {said}") from error
    assert refused > 50
