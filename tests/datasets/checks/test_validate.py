"""A clean dataset has no violations; each way of spoiling it is reported by file, key and reason."""

import json
import math
import shutil
import struct
import zlib

import cv2
import managing
import numpy as np
import pytest

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets.checks.dataset import validate
from robocas_ms3.datasets.sources.arrays import load_arrays

NPZ = "episode_0000001/episode_info.npz"


def arrays_of(root):
    return managing.arrays_of(root / "episode_0000001")


def change(root, **new):
    managing.change(root / "episode_0000001", **new)


def change_array(path, edit):
    np.save(path, edit(np.load(path)))


def found(root):
    report = validate(root)
    assert report.as_json()["valid"] is (not report.violations)
    return [str(violation) for violation in report.violations]


def assert_only(root, *texts):
    """Each violation is one of the texts, and each text was found."""
    violations = found(root)
    for text in texts:
        assert any(text in violation for violation in violations), f"{text!r} not in {violations}"
    for violation in violations:
        assert any(text in violation for text in texts), violation


def test_a_converted_dataset_is_valid(made):
    report = validate(made)
    assert report.violations == []
    assert (report.episodes, report.steps) == (2, 14)


def test_an_empty_folder(tmp_path):
    assert found(tmp_path) == [
        "conversion.json: expected this file (robocas import-robocas writes one), found no file",
        "data_info.json: expected this file, found no file",
    ]
    with pytest.raises(DatasetError):
        validate(tmp_path / "no folder")


def test_a_file_is_wrong_usage(tmp_path):
    (tmp_path / "trajectory.h5").touch()
    with pytest.raises(DatasetError) as caught:
        validate(tmp_path / "trajectory.h5")
    assert (caught.value.found, caught.value.usage) == ("a file", True)


@pytest.mark.parametrize(
    ("key", "value", "text"),
    [
        ("ee_pos", np.zeros((7, 3)), "expected float32, found float64"),
        ("gripper_status", np.ones(7, np.int64), "expected bool, found int64"),
        ("gripper_width", np.full(7, np.nan, np.float32), "expected finite numbers, found 7 NaN or infinite values"),
        ("step_lang_goals", np.array([b"x"] * 7), "expected str, found |S1"),
        ("episode_length", np.array([7, 7]), "expected shape (), found shape (2,)"),
        ("episode_length", np.array(10**9), "expected 1 to 10000 steps, found 1000000000"),
        ("rel_pos", np.array(0, np.float32), "expected shape (7, 3), found shape ()"),
        ("step_goal_type", np.array(["grasp"] * 6), "expected shape (7,), found shape (6,)"),
        ("step_goal_type", np.array(["dance"] * 7), "expected one of"),
        ("episode_length", np.array(6), "expected 7, the length of the arrays, found 6"),
    ],
)
def test_types_and_shapes(dataset, key, value, text):
    change(dataset, **{key: value})
    assert any(violation.startswith(f"{NPZ}, {key}: {text}") for violation in found(dataset))


def test_an_episode_without_steps(dataset):
    change(dataset, **{key: array[:0] for key, array in arrays_of(dataset).items() if array.shape[:1] == (7,)})
    change(dataset, episode_length=np.array(0))
    violations = found(dataset)
    assert f"{NPZ}, episode_length: expected 1 to 10000 steps, found 0" in violations
    assert any("rgb/0000.png: expected 0 images" in violation for violation in violations)


def damage_member(path):
    """Change what is deflated, in the first member of an archive."""
    arrays = dict(np.load(path))
    np.savez_compressed(path, **arrays)
    data = bytearray(path.read_bytes())
    name, extra = struct.unpack_from("<HH", data, 26)
    data[30 + name + extra] |= 6  # a type of block that deflate does not have
    path.write_bytes(data)


def test_a_damaged_member_of_an_archive(dataset):
    damage_member(dataset / NPZ)
    assert any(v.startswith(f"{NPZ}, ") for v in found(dataset))
    assert len(load_arrays(dataset / NPZ).unreadable) == 1


def chunk(kind, data=b""):
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def test_image_without_pixels(dataset):
    """Each checksum is right, and there is nothing between header and end."""
    path = dataset / "episode_0000001" / "base_camera" / "depth" / "0000.png"
    head = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">IIBBBBB", 64, 48, 16, 0, 0, 0, 0))
    path.write_bytes(head + chunk(b"IEND"))
    place = "episode_0000001/base_camera/depth/0000.png"
    assert found(dataset) == [f"{place}: expected an intact image, found PNG without image data (no IDAT chunk)"]
    pixels = chunk(b"IDAT", b"no deflated data")
    path.write_bytes(head + pixels + chunk(b"IEND"))
    assert any(place in violation for violation in found(dataset))


def put(a, key, row, value):
    array = a[key].copy()
    array[row] = value
    return {key: array}


@pytest.mark.parametrize(
    ("new", "texts"),
    [
        (lambda a: {"speed": np.zeros(7)}, ["speed: expected no keys outside the schema"]),
        (
            lambda a: put(a, "ee_orn", 3, a["ee_orn"][3] * 1.1),
            ["ee_orn: expected unit quaternions, found off by 0.1"],
        ),
        (
            lambda a: put(a, "base_rel_pos", (2, 0), 9),
            ["base_rel_pos: expected the motion between rows of base_pos, base_orn, found 1 of 7"],
        ),
        (
            lambda a: {
                "gripper_width": a["gripper_width"] * 10,
                "rel_agv_pose": a["rel_agv_pose"] + 0.1,
                "language_embedding": a["language_embedding"] * 2,
            },
            [
                "gripper_width: expected -0.005 to 0.085 m, found 0.4",
                "rel_agv_pose: expected differences of agv_pose, found off by 0.1",
                "language_embedding: expected unit length, found off by 1",
            ],
        ),
    ],
)
def test_values(dataset, new, texts):
    change(dataset, **new(arrays_of(dataset)))
    assert_only(dataset, *(f"{NPZ}, {text}" for text in texts))


def test_wxyz_is_recognised(dataset):
    arrays = arrays_of(dataset)
    change(dataset, **{key: np.roll(arrays[key], 1, axis=1) for key in ("ee_orn", "rel_orn")})
    assert f"{NPZ}, ee_orn, rel_orn: expected quaternions xyzw, found quaternions wxyz" in found(dataset)


def test_embeddings_in_one_episode_only(dataset):
    change(dataset, language_embedding=None, step_goal_embs=None)
    assert_only(dataset, "language_embedding: expected in all episodes or in none, found in some episodes")


def test_images(dataset):
    rgb = dataset / "episode_0000000" / "static_camera" / "rgb"
    depth = dataset / "episode_0000000" / "static_camera" / "depth"
    (rgb / "0002.png").unlink()
    shutil.copy(rgb / "0001.png", rgb / "0007.png")
    data = (rgb / "0003.png").read_bytes()
    (rgb / "0003.png").write_bytes(data[:-20])
    (rgb / "0004.png").write_bytes(data[:200] + bytes([data[200] ^ 1]) + data[201:])
    image = cv2.imread(str(rgb / "0005.png"))
    cv2.imwrite(str(rgb / "0005.png"), image[:40])
    cv2.imwrite(str(depth / "0006.png"), np.full((48, 64), 200, np.uint8))
    place = "episode_0000000/static_camera"
    assert sorted(found(dataset)) == [
        f"{place}/depth/0006.png: expected 64 x 48, 1 x 16 bit, found 64 x 48, 1 x 8 bit",
        f"{place}/rgb/0002.png: expected an image of each step, found no file",
        f"{place}/rgb/0003.png: expected an intact image, found truncated PNG",
        f"{place}/rgb/0004.png: expected an intact image, found damaged PNG: wrong checksum",
        f"{place}/rgb/0005.png: expected 64 x 48, 3 x 8 bit, found 64 x 40, 3 x 8 bit",
        f"{place}/rgb/0007.png: expected 7 images from 0000.png, found an additional file",
    ]


def test_camera_files(dataset):
    folder = dataset / "episode_0000000"
    (folder / "base_camera" / "intrinsic.npy").unlink()
    change_array(folder / "gripper_camera" / "cam_pose_wrt_ee.npy", lambda pose: pose + np.eye(4)[:, ::-1] * 0.1)
    change_array(folder / "static_camera" / "cam_pose_wrt_world.npy", np.linalg.inv)
    static = "episode_0000000/static_camera/cam_pose_wrt_world.npy"
    assert sorted(found(dataset)) == [
        "episode_0000000/base_camera/intrinsic.npy: expected this file, found no file",
        "episode_0000000/gripper_camera/cam_pose_wrt_ee.npy: expected a rigid transform, found another matrix",
        f"{static}: expected the pose of cam_pos_wrt_world.npy, found another pose",
    ]


def turned(pose):
    """By 5 deg about the camera's own x."""
    c, s = np.cos(np.deg2rad(5)), np.sin(np.deg2rad(5))
    return pose @ np.array([[1, 0, 0, 0], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1]])


def poses(parent, edit):
    names = [f"{name}_wrt_{parent}.npy" for name in ("cam_pos", "cam_pose", "true_cam_pose")]
    return lambda folder: [change_array(folder / name, edit) for name in names]


def depth(edit):
    def spoil(folder):
        for path in (folder / "depth").iterdir():
            cv2.imwrite(str(path), edit(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)))

    return spoil


WRONG_VIEWS = {
    "turned by 5 deg": ("base_camera", poses("arm_base", turned)),
    "inverted": ("gripper_camera", poses("ee", np.linalg.inv)),
    "OpenGL frame": ("static_camera", poses("world", lambda pose: pose @ np.diag([1.0, -1, -1, 1]))),
    "permuted axes": ("base_camera", poses("arm_base", lambda pose: pose @ np.eye(4)[[1, 2, 0, 3]])),
    "zoomed": ("base_camera", lambda folder: change_array(folder / "intrinsic.npy", lambda k: k * [1.1, 1.1, 1, 1])),
    "centimetres": ("base_camera", depth(lambda pixels: pixels // 10)),
    "mirrored": ("base_camera", depth(lambda pixels: np.ascontiguousarray(pixels[:, ::-1]))),
    "nothing": ("static_camera", depth(lambda pixels: pixels * 0)),
}


@pytest.mark.parametrize("name", WRONG_VIEWS)
def test_wrong_poses_intrinsics_and_depth_are_reported_for_their_episode(dataset, name):
    camera, spoil = WRONG_VIEWS[name]
    spoil(dataset / "episode_0000001" / camera)
    violations = found(dataset)
    assert all(v.startswith("episode_0000001/") and "/depth/" in v for v in violations)
    assert any(camera in v for v in violations)


@pytest.mark.parametrize(
    ("edit", "text"),
    [
        (lambda info: info.pop("val_eps"), "data_info.json, val_eps: expected this key"),
        (lambda info: info["train_eps"].extend(info["val_eps"]), "expected no episode in both"),
        (lambda info: info.update(train_eps="all"), "train_eps: expected a list"),
        (lambda info: info["ep_length"].update({"1": 8}), "ep_length.1: expected 7, found 8"),
        (
            lambda info: info["ep_length"].pop("0"),
            "ep_length: expected the episodes on disk, found 1 missing",
        ),
        (lambda info: info["language_goal"].update({"0": "dance"}), "language_goal.0: expected 'grasp the cube 3"),
        (lambda info: info["step_goals"]["0"][0].update(goal_range=[0, 1]), "step_goals.0: expected a range from 2"),
        (lambda info: info["step_goals"]["0"].pop(), "step_goals.0: expected ranges up to step 6, found up to 2"),
        (lambda info: info["step_goals"]["0"][0].update(goal_type="dance"), "step_goals.0: expected the sub-goal"),
        (lambda info: info["action_space"].pop("relative_rotation"), "action_space.relative_rotation: expected"),
        (
            lambda info: info["action_space"]["relative_position"][0].__setitem__(0, 9.0),
            "expected the percentiles",
        ),
        (
            lambda info: info["action_space"]["relative_position"][0].__setitem__(0, math.nan),
            "is not a finite number",
        ),
    ],
)
def test_data_info(dataset, edit, text):
    managing.edit(dataset / "data_info.json", edit)
    violations = found(dataset)
    assert any(text in violation for violation in violations), violations
    assert all(violation.startswith("data_info.json") for violation in violations)


def test_command(dataset, capsys):
    from robocas_ms3.cli.validate import Validate, main

    assert main(Validate(dataset)) == 0
    assert "2 episodes, 14 steps, valid" in capsys.readouterr().out
    change(dataset, speed=np.zeros(7))
    assert main(Validate(dataset, json=True)) == 1
    report = json.loads(capsys.readouterr().out)
    assert report["violations"] == [
        {"file": NPZ, "key": "speed", "expected": "no keys outside the schema", "found": "an unknown key"}
    ]


def test_conversion_json_lists_the_episodes_on_disk(dataset):
    shutil.copytree(dataset / "episode_0000001", dataset / "episode_0000002")
    violations = found(dataset)
    assert "episode_0000002: expected each episode once, found the arrays of episode_0000001" in violations
    assert "conversion.json, episodes.2: expected an entry for each episode, found no entry" in violations
    path = dataset / "conversion.json"
    managing.edit(path, lambda content: content["episodes"].update({"2": content["episodes"]["1"]}))
    assert "conversion.json, episodes.2: expected each recording once, found the recording of episode 1" in found(
        dataset
    )
    shutil.rmtree(dataset / "episode_0000002")
    managing.edit(path, lambda content: content["episodes"]["2"].update(recording="another"))
    assert_only(dataset, "conversion.json, episodes.2: expected the episodes on disk, found no folder")


def test_single_camera_needs_no_agreement(dataset):
    managing.edit(dataset / "conversion.json", lambda content: content.update(cameras=["static_camera"]))
    for name in ("base_camera", "gripper_camera"):
        for folder in dataset.glob(f"*/{name}"):
            shutil.rmtree(folder)
    assert found(dataset) == []
