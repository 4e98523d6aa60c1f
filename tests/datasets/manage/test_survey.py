"""Survey of datasets in the format of RoboCAS-v0: findings and importable episodes."""

import shutil

import cv2
import numpy as np
from managing import edit, imported, problems

from robocas_ms3.datasets import schema
from robocas_ms3.datasets.checks.dataset import validate
from robocas_ms3.datasets.manage.repairs import find_eef_rotation
from robocas_ms3.datasets.manage.survey import survey_dataset

NPZ = "episode_info.npz"
NAMES = ("base", "gripper", "static")


def test_finding_of_all_episodes_is_reported_once(copy):
    assert [(f.episode, f.violation.file, f.outcome) for f in survey_dataset(copy).findings] == [
        (None, "conversion.json", "repaired"),
        (None, NPZ, "repaired"),
        (None, NPZ, "repaired"),
        *(
            (None, f"{camera}/cam_pose_wrt_{parent}.npy", "repaired")
            for camera, parent in (("base_camera", "arm_base"), ("gripper_camera", "ee"), ("static_camera", "world"))
        ),
        (None, "scene.json", "warning"),
    ]
    poses = copy / "episode_0000002" / "static_camera"
    shutil.copy(poses / "cam_pos_wrt_world.npy", poses / "cam_pose_wrt_world.npy")
    found = [f for f in survey_dataset(copy).findings if "static_camera" in f.violation.file]
    assert [(f.episode, f.violation.file) for f in found] == [
        (n, f"episode_000000{n}/static_camera/cam_pose_wrt_world.npy") for n in (0, 1, 3)
    ]


def test_valid_dataset_has_no_findings(made):
    assert survey_dataset(made).findings == []


def test_eef_frame_of_a_recorded_episode_is_not_rotated(dataset):
    def turned():
        return [f.episode for f in survey_dataset(dataset).findings if "ee_orn" in f.violation.key]

    folder = dataset / schema.episode_folder(1)
    pose = np.load(folder / "gripper_camera" / "cam_pos_wrt_ee.npy")
    pose[:2, 3] = 0, 0.05
    np.save(folder / "gripper_camera" / "cam_pos_wrt_ee.npy", pose)
    assert turned() == []
    edit(folder / "scene.json", lambda scene: scene.update(env_info=None))  # as of a dataset made elsewhere
    assert turned() == [1]


def test_eef_turn_by_hand():
    def camera_at(x, y):
        pose = np.eye(4)
        pose[:2, 3] = x, y
        return pose

    assert [find_eef_rotation(camera_at(x, y)) for x, y in ((0.05, 0), (0, 0.05), (-0.05, 0), (0, -0.05))] == [
        0,
        90,
        180,
        -90,
    ]
    assert find_eef_rotation(camera_at(0, 0.2)) == 0  # not the known camera
    assert find_eef_rotation(camera_at(0.04, 0.04)) == 0


def test_missing_damaged_and_other_images(copy, tmp_path):
    rgb = copy / "episode_0000001" / "base_camera" / "rgb"
    (rgb / "0002.png").unlink()
    (rgb / "0003.png").write_bytes((rgb / "0003.png").read_bytes()[:99])
    shutil.rmtree(copy / "episode_0000002" / "static_camera" / "depth")
    depth = copy / "episode_0000003" / "gripper_camera" / "depth"
    shutil.copy(depth / "0006.png", depth / "0007.png")
    for path in (copy / "episode_0000000").glob("*/depth/*.png"):
        cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_UNCHANGED).astype(np.uint8))
    assert problems(copy, "skipped") == [
        *((0, f"{name}_camera/depth/0000.png", "64 x 48, 1 x 8 bit", "and 6 more") for name in NAMES),
        (1, "base_camera/rgb/0002.png", "no file", "and 1 more"),
        (2, "static_camera/depth/0000.png", "no file", "and 6 more"),
    ]
    assert (3, "gripper_camera/depth/0007.png", "an additional file", "") in problems(copy, "warning")
    new = imported(copy, tmp_path / "out")
    assert new.numbers == [3]
    assert validate(new.root).violations == []


def test_other_image_sizes_and_duplicate_episodes(copy, tmp_path):
    shutil.copytree(copy / "episode_0000001", copy / "episode_0000009")
    shutil.copytree(copy / "episode_0000002", copy / "episode_0000008")
    for path in (copy / "episode_0000001").glob("*/*/*.png"):
        cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[:40])
    size = "base_camera, gripper_camera, static_camera, 64 x 40 png, with depth"
    assert problems(copy, "skipped") == [
        (1, "episode_0000001", size, ""),
        (8, "episode_0000008", "the arrays of episode 2", ""),
    ]
    assert imported(copy, tmp_path / "out").numbers == [0, 2, 3, 9]


def test_cameras(copy, tmp_path):
    (copy / "episode_0000000" / "base_camera" / "intrinsic.npy").unlink()
    (copy / "episode_0000001" / "base_camera" / "cam_pos_wrt_arm_base.npy").unlink()
    np.save(copy / "episode_0000002" / "static_camera" / "cam_pos_wrt_world.npy", np.ones((4, 4)))
    found = problems(copy, "skipped")
    assert [(episode, file) for episode, file, *_ in found] == [
        (0, "base_camera"), (1, "base_camera"), (2, "static_camera")
    ]  # fmt: skip
    assert [text for *_, text, _ in found[1:]] == ["missing pose of a camera", "another matrix"]


def test_rgb_only_and_fewer_cameras(copy, tmp_path):
    for path in [*copy.glob("*/static_camera"), *copy.glob("*/*/depth")]:
        shutil.rmtree(path, ignore_errors=True)
    new = imported(copy, tmp_path / "out")
    assert (new.settings["cameras"], new.settings["depth"]) == (["base_camera", "gripper_camera"], False)
    assert validate(new.root).violations == []


def test_the_overview(copy, tmp_path):
    def spoil(info):
        info.update(train_eps=[0, 7, 0], val_eps=[2])
        info["ep_length"]["0"] = 9
        info["language_goal"]["2"] = "dance"

    edit(copy / "data_info.json", spoil)
    found = [(episode, text) for episode, _, text, _ in problems(copy, "repaired") if episode is not None]
    assert found == [
        (0, "a repeated episode"),
        (0, "7"),
        (1, "an unlisted episode"),
        (2, "'grasp the cube 2 on the table and move it to the basket'"),
        (3, "an unlisted episode"),
        (7, "an episode without a folder"),
    ]
    new = imported(copy, tmp_path / "out")
    assert 2 in new.info["val_eps"]
    assert 0 in new.info["train_eps"]
    assert validate(new.root).violations == []
    (copy / "data_info.json").write_text("{")
    assert problems(copy, "repaired")[0][:2] == (None, "data_info.json")
    assert validate(imported(copy, tmp_path / "again").root).violations == []
