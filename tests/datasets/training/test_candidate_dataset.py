"""Samples of decisions: values, padding, other targets, splits by seed, and workers."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch
from recorded_candidates import write_recorded_candidates
from synthetic import SIZE, RayCaster, write_trajectory
from synthetic_candidates import ENV_INFO, SETTINGS, make_record, write_episodes
from torch.utils.data import DataLoader

from robocas_ms3.core.errors import DatasetError, EmptySplitError
from robocas_ms3.datasets import CandidateDataset, CandidateOptions
from robocas_ms3.datasets.candidate_images.images_file import CandidateImages, images_path
from robocas_ms3.datasets.candidate_images.render import render_candidates
from robocas_ms3.datasets.candidate_images.settings import CandidateImageSettings
from robocas_ms3.demos.candidates.candidates_file import CandidateFile, write_candidates
from robocas_ms3.demos.candidates.schema import PRIMITIVES

ALL = CandidateOptions(split="all")


def test_sample_has_the_values_of_the_file(tmp_path):
    path = write_episodes(tmp_path / "c.h5")
    file, dataset = CandidateFile(path), CandidateDataset(path, ALL)
    assert len(dataset) == len(file) == 4
    sample, decision = dataset[1], file.decision(1)
    for key, name in (("object_pose", "object_in_base"), ("tcp_pose", "tcp_in_base"), ("qpos", "qpos")):
        np.testing.assert_array_equal(sample[key], decision.values[name])
    assert sample["target"].tolist() == [1, 0, 0, 0, 0]
    assert sample["grasped"].tolist() == [0, 0, 0, 0, 0]
    assert sample["opening"] == 0
    np.testing.assert_array_equal(sample["clutter"][:, 1], decision.values["obstacles"])
    assert sample["mask"].tolist() == [True] * 6
    assert [PRIMITIVES[index] for index in sample["primitive"]] == decision.candidates["primitive"].tolist()
    for key in ("slot", "chosen", "feasible", "success", "held", "seconds", "disturbed"):
        np.testing.assert_array_equal(sample[key], decision.candidates[key])
    assert sample["end_pose"][0].tolist() == [0] * 7  # of a grasp
    np.testing.assert_array_equal(sample["end_pose"][1], decision.candidates["end_in_base"][1])
    np.testing.assert_array_equal(sample["object_pose_after"], decision.candidates["object_after_in_base"])
    labels, rows = file.labels, file.rows_of(1)
    np.testing.assert_allclose(sample["benefit"], labels.for_target(labels.benefit)[rows], rtol=1e-5)
    np.testing.assert_array_equal(sample["helped"], labels.for_target(labels.helped)[rows])
    assert (sample["seed"], sample["row"], sample["file"]) == (3, 1, 0)
    assert sample["instruction"] == decision.values["instruction"]
    assert sample["target_name"] == "screwdriver"


def test_slots_and_candidates_are_padded(tmp_path):
    paths = [
        write_episodes(tmp_path / f"{slots}.h5", seeds=(slots,), slots=slots, candidates=slots) for slots in (3, 5)
    ]
    dataset = CandidateDataset(paths, ALL)
    sample = dataset[0]
    assert sample["object_pose"].shape == (5, 7)
    assert sample["present"].tolist() == [True] * 3 + [False] * 2
    assert sample["mask"].tolist() == [True] * 3 + [False] * 2
    assert sample["primitive"][3:].tolist() == [-1, -1]
    assert sample["object_pose_after"].shape == (5, 5, 7)
    assert not sample["object_pose_after"][3:].any()
    assert all(torch.isfinite(value).all() for value in sample.values() if isinstance(value, torch.Tensor))
    batch = next(iter(DataLoader(dataset, batch_size=4)))
    assert batch["object_pose"].shape == (4, 5, 7)
    assert len(batch["instruction"]) == 4


def test_fewer_candidates_contain_the_chosen_one(tmp_path):
    path = write_episodes(tmp_path / "c.h5", seeds=range(20))
    dataset = CandidateDataset(path, replace(ALL, max_candidates=2))
    kinds = set()
    for index in range(len(dataset)):
        sample = dataset[index]
        assert sample["chosen"].tolist() == [True, False]
        assert torch.equal(sample["start_pose"], dataset[index]["start_pose"])
        kinds.add(int(sample["primitive"][1]))
    assert kinds == {0, 1, 2}


def test_other_targets_have_their_own_labels_and_instructions(tmp_path):
    record = make_record(3, 0, slots=4, candidates=3)
    record.values["object_name"] = ["screwdriver", "mug", "peach", "peach"]
    write_candidates(tmp_path / "c.h5", [record], ENV_INFO, SETTINGS)
    dataset = CandidateDataset(tmp_path / "c.h5", replace(ALL, targets="all"))
    samples = [dataset[index] for index in range(len(dataset))]
    assert [sample["target_name"] for sample in samples] == ["screwdriver", "mug"]  # two objects are called peach
    assert samples[1]["instruction"] != samples[0]["instruction"]
    assert samples[1]["instruction"] == dataset[1]["instruction"]
    assert not samples[1]["chosen"].any()
    benefit = CandidateFile(tmp_path / "c.h5").labels.benefit
    for slot in (0, 1):
        np.testing.assert_allclose(samples[slot]["benefit"], benefit[:, slot], rtol=1e-5)
    record.values["held_slot"] = 0
    write_candidates(tmp_path / "c.h5", [record], ENV_INFO, SETTINGS)
    assert len(CandidateDataset(tmp_path / "c.h5", replace(ALL, targets="all"))) == 1


def test_splits_have_no_seed_in_common(tmp_path):
    path = write_episodes(tmp_path / "c.h5", seeds=range(20))
    splits = [CandidateDataset(path, CandidateOptions(split=split)) for split in ("train", "val", "all")]
    seeds = [{sample["seed"] for sample in split} for split in splits]  # type: ignore[union-attr]
    assert (len(splits[0]), len(splits[1]), len(splits[2])) == (36, 4, 40)
    assert not seeds[0] & seeds[1]


def test_kinds_of_decisions(tmp_path):
    path = write_episodes(tmp_path / "c.h5")
    assert len(CandidateDataset(path, replace(ALL, kinds=("move",)))) == 4
    with pytest.raises(DatasetError):
        CandidateDataset(path, replace(ALL, kinds=("pull",)))


def test_split_without_decisions_is_an_error(tmp_path):
    path = write_episodes(tmp_path / "c.h5", seeds=(3,))
    with pytest.raises(EmptySplitError):
        CandidateDataset(path, CandidateOptions(split="val"))


@pytest.mark.parametrize("option", [{"split": "test"}, {"targets": "some"}, {"kinds": ("x",)}, {"max_candidates": 0}])
def test_invalid_options_are_errors(option):
    with pytest.raises(DatasetError):
        CandidateOptions(**option)


def count_candidates(sample):
    return int(sample["mask"].sum())


def test_dataset_can_be_pickled_and_read_by_workers(tmp_path):
    dataset = CandidateDataset(write_episodes(tmp_path / "c.h5"), ALL)
    again = pickle.loads(pickle.dumps(dataset))
    (tmp_path / "c.h5").unlink()
    assert torch.equal(again[2]["object_pose"], dataset[2]["object_pose"])
    batches = list(DataLoader(dataset, batch_size=2, num_workers=2))
    assert [batch["seed"].tolist() for batch in batches] == [[3, 3], [4, 4]]


def test_transform(tmp_path):
    dataset = CandidateDataset(write_episodes(tmp_path / "c.h5"), ALL, transform=count_candidates)
    assert dataset[0] == 6


@pytest.fixture(scope="module")
def rendered(tmp_path_factory):
    """Return the path of a file with rendered decisions."""
    folder = tmp_path_factory.mktemp("rendered")
    trajectory = write_trajectory(folder / "trajectory.h5", seeds=(3, 4))
    path = write_recorded_candidates(folder / "candidates.h5", trajectory, (0, 8))
    render_candidates(CandidateImageSettings(path, open_renderer=RayCaster))
    return path


def test_images_of_decisions(rendered):
    cameras = ("static_camera", "base_camera")
    dataset = CandidateDataset(rendered, replace(ALL, cameras=cameras, depth=True))
    images, sample = CandidateImages(images_path(rendered)), dataset[3]
    for index, camera in enumerate(cameras):
        np.testing.assert_array_equal(sample["rgb"][index].permute(1, 2, 0), images.rgb(3, camera))
        np.testing.assert_allclose(sample["depth"][index], images.depth(3, camera) / 1000, rtol=1e-6)
        fx, fy, cx, cy = images.intrinsic(3, camera)
        np.testing.assert_allclose(sample["intrinsics"][index], [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], rtol=1e-6)
        np.testing.assert_allclose(sample["camera_in_base"][index], images.camera_in_base(3, camera), rtol=1e-6)
    half = SIZE[0] // 2, SIZE[1] // 2
    scaled = CandidateDataset(rendered, replace(ALL, cameras=cameras, size=half))[3]
    assert scaled["rgb"].shape == (2, 3, half[1], half[0])
    torch.testing.assert_close(scaled["intrinsics"][:, :2], sample["intrinsics"][:, :2] / 2)
    assert "depth" not in scaled


def test_images_that_are_not_available_are_errors(rendered, tmp_path):
    with pytest.raises(DatasetError):
        CandidateDataset(rendered, replace(ALL, cameras=("front_camera",)))
    with pytest.raises(DatasetError):
        CandidateDataset(write_episodes(tmp_path / "c.h5"), replace(ALL, cameras=("base_camera",)))
