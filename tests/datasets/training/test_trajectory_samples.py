"""The torch dataset of a trajectory file, which has state and actions but no images."""

import shutil

import h5py
import numpy as np
import pytest
import torch

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets import RoboCASDataset
from robocas_ms3.datasets.training.options import SampleOptions


def test_samples_of_trajectory_and_conversion_are_equal(made, trajectory):
    keys = ("robot_joints", "arm_joint_vel", "gripper_width", "agv_pose", "gripper_status")
    options = dict(cameras=(), observation_horizon=3, action_horizon=4, state=keys, subgoals=True)
    for side in ("train", "val", "all"):
        folder = RoboCASDataset(made, SampleOptions(split=side, **options))
        file = RoboCASDataset(trajectory, SampleOptions(split=side, **options))
        assert (len(folder), folder.episodes) == (len(file), file.episodes)
        assert np.array_equal(folder.subgoal_types, file.subgoal_types)
        for one, other in zip(folder, file, strict=True):
            for key, value in one.items():
                if key == "action":  # the synthetic robot has made-up kinematics
                    assert torch.equal(value[:, 6], other[key][:, 6])
                else:
                    assert torch.equal(value, other[key]) if torch.is_tensor(value) else value == other[key], key


def test_trajectories_at_another_rate_and_with_failures(trajectory):
    data = RoboCASDataset(
        trajectory, SampleOptions(split="all", cameras=(), rate_hz=10, include_failed=True, normalize=True)
    )
    assert len(data) == 3 * 11  # 22 control steps in pairs
    assert float(data[0]["action"][:, :6].abs().max()) <= 1
    with pytest.raises(DatasetError, match="not a divisor of the control frequency"):
        RoboCASDataset(trajectory, SampleOptions(cameras=(), rate_hz=3))


def test_trajectories_of_end_effector_actions(trajectory, tmp_path):
    path = tmp_path / "F.h5"
    shutil.copy(trajectory, path)
    entries = trajectory.with_suffix(".json").read_text().replace("pd_joint_pos", "pd_ee_delta_pose")
    path.with_suffix(".json").write_text(entries)
    with h5py.File(path, "a") as file:
        for group in file.values():
            actions = np.delete(group["actions"][:], 0, axis=1)  # 6 of motion, then the gripper
            del group["actions"]
            group["actions"] = actions
    options = dict(split="all", cameras=(), state=("gripper_status",))
    for one, other in zip(
        RoboCASDataset(trajectory, SampleOptions(**options)),
        RoboCASDataset(path, SampleOptions(**options)),
        strict=True,
    ):
        assert torch.equal(one["action"], other["action"])


@pytest.mark.parametrize("options", [dict(), dict(cameras=(), depth=True), dict(cameras=(), embedding=True)])
def test_trajectory_files_have_no_images(trajectory, options):
    with pytest.raises(DatasetError):
        RoboCASDataset(trajectory, SampleOptions(**options))
