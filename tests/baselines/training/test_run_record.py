"""Hashes of data and weights in the record of a run."""

import numpy as np
import pytest

from robocas_ms3.baselines.training.record import WEIGHTS, hash_dataset, hash_weights
from robocas_ms3.core.errors import TrainingError


def test_hash_of_a_trajectory_has_both_files(tmp_path):
    path = tmp_path / "trajectory.h5"
    path.write_text("states")
    alone = hash_dataset(path)
    path.with_suffix(".json").write_text("seeds")
    assert hash_dataset(path) != alone
    path.with_suffix(".json").write_text("other seeds")
    assert len({alone, hash_dataset(path)}) == 2


def test_hash_of_a_folder_has_arrays_and_image_sizes(tmp_path):
    for name, text in (("data_info.json", "{}"), ("episode_0/rgb/0.png", "abc"), ("preview/0.png", "a")):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    before = hash_dataset(tmp_path)
    (tmp_path / "preview/0.png").write_text("bcd")
    assert hash_dataset(tmp_path) == before
    (tmp_path / "episode_0/rgb/0.png").write_text("abcd")
    longer = hash_dataset(tmp_path)
    (tmp_path / "data_info.json").write_text("[]")
    hashes = {before, longer, hash_dataset(tmp_path)}
    for at in (0.1, 0.2):  # the pose of a camera
        np.save(tmp_path / "cam_pos_wrt_ee.npy", np.full((4, 4), at))
        hashes.add(hash_dataset(tmp_path))
    assert len(hashes) == 5


def test_missing_dataset_is_an_error(tmp_path):
    with pytest.raises(TrainingError, match="no such dataset"):
        hash_dataset(tmp_path / "nowhere")


def test_hash_of_weights(tmp_path):
    assert hash_weights(tmp_path) == ""
    (tmp_path / WEIGHTS).write_bytes(b"")
    assert (
        hash_weights(tmp_path) == "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855"
    )  # of an empty file


def test_a_repeated_recording_has_the_same_hash(tmp_path):
    """`robocas generate` updates the durations in its own files when a finished run is repeated."""
    (tmp_path / "pick").mkdir()
    (tmp_path / "pick" / "candidates.h5").write_bytes(b"decisions")
    before = hash_dataset(tmp_path)
    for name in ("run.json", "summary.json", "failures.jsonl"):
        (tmp_path / "pick" / name).write_text("durations")
    assert hash_dataset(tmp_path) == before
    (tmp_path / "pick" / "candidates.h5").write_bytes(b"otherwise")
    assert hash_dataset(tmp_path) != before
