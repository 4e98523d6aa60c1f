"""Import of datasets in the format of RoboCAS-v0, made from converted ones by removing and renaming keys."""

import json

import numpy as np
import pytest
from managing import Bomb, arrays_of, as_v0, change, files_of, imported, problems, read
from scipy.spatial.transform import Rotation

from robocas_ms3.cli.main import run
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.checks.dataset import validate
from robocas_ms3.datasets.images.video import write_contact_sheet
from robocas_ms3.datasets.manage.import_robocas import import_robocas
from robocas_ms3.datasets.manage.survey import survey_dataset
from robocas_ms3.datasets.sources.file_models import SCENE_KEYS
from robocas_ms3.datasets.sources.reader import Dataset

NPZ = "episode_info.npz"


@pytest.fixture
def v0(dataset):
    return as_v0(dataset)


def test_output_equal_to_input_is_refused(four, capsys):
    for out in (four, four / "inside", four.parent):
        assert run(["import-robocas", str(four), "--out", str(out)]) == 1
        assert "--overwrite" not in capsys.readouterr().err


@pytest.mark.parametrize("pose_name", ["cam_pos_wrt", "cam_pose_wrt"])
def test_v0_dataset_becomes_valid(dataset, made, tmp_path, pose_name):
    root, out = as_v0(dataset, pose_name), tmp_path / "out"
    before = files_of(root)
    new = imported(root, out)
    assert validate(out).violations == []
    assert new.info == read(made / "data_info.json")
    assert new.settings["embeddings"] is False
    for number in (0, 1):
        name = f"episode_{number:07d}"
        old, now = arrays_of(made / name), arrays_of(out / name)
        assert list(now) == [spec.name for spec in schema.EPISODE_INFO if not (spec.embedding or spec.optional)]
        for key, array in now.items():
            if array.dtype.kind == "f":
                np.testing.assert_allclose(array, old[key], atol=1e-6)
            else:
                np.testing.assert_array_equal(array, old[key])
        for path in (made / name).glob("*/*.npy"):
            np.testing.assert_array_equal(np.load(out / path.relative_to(made)), np.load(path))
        for path in (made / name).glob("*/*/*.png"):
            assert (out / path.relative_to(made)).read_bytes() == path.read_bytes()
        scene = new.episode(number).scene
        assert list(scene) == list(SCENE_KEYS)
        assert {key for key, value in scene.items() if value is not None} == {"schema_version", "rate_hz", "source"}
        assert scene["source"]["format"] == "robocas v0"
        assert scene["source"]["derived"] == {"agv_pose": "base_pos, base_orn", "rel_agv_pose": "agv_pose"}
    assert read(out / "import_report.json")["importable"] == 2
    write_contact_sheet(Dataset(out), tmp_path / "sheet.png")
    assert files_of(root) == before


def test_other_types_and_axes(v0, made, tmp_path):
    episode = v0 / "episode_0000000"
    arrays = arrays_of(episode)
    change(
        episode,
        ee_pos=arrays["ee_pos"].astype(np.float64),
        robot_joints=arrays["robot_joints"].astype(np.float64),
        gripper_width=arrays["gripper_width"][:, None],
        gripper_status=arrays["gripper_status"].astype(np.float32)[:, None],
        episode_length=np.array([7], np.int32),
        language_goal=np.array([str(arrays["language_goal"]).encode()]),
        step_goal_type=np.char.encode(arrays["step_goal_type"]),
        speed=np.zeros(7),
    )
    intrinsic = np.load(episode / "base_camera" / "intrinsic.npy")
    fx, fy, cx, cy = intrinsic
    np.save(episode / "base_camera" / "intrinsic.npy", np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]))
    np.testing.assert_array_equal(Dataset(v0).episode(0).intrinsic("base_camera"), intrinsic)
    assert (0, f"{NPZ}, speed", "an unknown key", "not imported") in problems(v0, "warning")
    new = imported(v0, tmp_path / "out")
    assert validate(new.root).violations == []
    old = arrays_of(made / "episode_0000000")
    for key in ("ee_pos", "gripper_width", "gripper_status", "language_goal", "step_goal_type", "episode_length"):
        np.testing.assert_array_equal(new.episode(0).arrays[key], old[key])


def test_pickles_are_never_loaded(v0, tmp_path):
    pickles = np.array([Bomb() for _ in range(7)], object)
    change(v0 / "episode_0000000", robot_joints=pickles)
    change(v0 / "episode_0000001", step_lang_goals=pickles, speed=pickles)
    pickled = "pickled objects, which are never loaded"
    with pytest.raises(DatasetError, match=f"robot_joints: this array can't be read .found {pickled}"):
        _ = Dataset(v0).episode(0).arrays
    assert (0, f"{NPZ}, robot_joints", pickled, "") in problems(v0, "skipped")
    # Texts are in data_info.json, too.
    assert (1, f"{NPZ}, step_lang_goals", pickled, "derived from data_info.json") in problems(v0, "repaired")
    new = imported(v0, tmp_path / "out")
    assert new.numbers == [1]
    assert validate(new.root).violations == []


def test_relative_motion_in_the_convention_of_the_paper(v0, made, tmp_path):
    episode = v0 / "episode_0000001"
    arrays = arrays_of(episode)
    change(episode, **{key: np.roll(arrays[key], 1, axis=0) for key in ("rel_pos", "rel_orn")})
    new = imported(v0, tmp_path / "out")
    np.testing.assert_allclose(
        new.episode(1).arrays["rel_pos"], arrays_of(made / "episode_0000001")["rel_pos"], atol=1e-6
    )
    assert any("moved by one step" in text for text in new.episode(1).scene["source"]["repaired"])


def test_last_motion_becomes_identity_and_missing_velocities_are_derived(v0):
    arrays = arrays_of(v0 / "episode_0000000")
    motion = arrays["base_rel_pos"]
    motion[-1] = 1
    joints = np.arange(7, dtype=np.float32)[:, None] * np.full(7, 0.1, np.float32)
    change(v0 / "episode_0000000", base_rel_pos=motion)
    change(v0 / "episode_0000001", robot_joints=joints, arm_joint_vel=None)
    repaired = {(episode, where): repair for episode, where, _, repair in problems(v0, "repaired")}
    assert "identity" in repaired[0, f"{NPZ}, base_rel_pos"]
    np.testing.assert_allclose(Dataset(v0).episode(1).arrays["arm_joint_vel"], 0.5, atol=1e-5)  # 0.1 rad at 5 Hz


def test_quaternions_wxyz(v0, tmp_path):
    for episode in v0.glob("episode_*"):
        arrays = arrays_of(episode)
        keys = ("ee_orn", "rel_orn", "base_orn", "base_rel_orn")
        change(episode, **{key: np.roll(arrays[key], 1, axis=1) for key in keys})
    found = problems(v0, "repaired")
    assert (None, f"{NPZ}, ee_orn, rel_orn", "quaternions wxyz", "converted from wxyz") in found
    imported(v0, tmp_path / "out")
    assert validate(tmp_path / "out").violations == []


def test_values_out_of_range_are_imported_with_a_warning(v0, tmp_path):
    widths = arrays_of(v0 / "episode_0000000")["gripper_width"]
    change(v0 / "episode_0000000", gripper_width=np.full_like(widths, 0.5))
    assert (0, f"{NPZ}, gripper_width", "0.500 to 0.500", "") in problems(v0, "warning")
    assert imported(v0, tmp_path / "out").numbers == [0, 1]
    (violation,) = validate(tmp_path / "out").violations
    assert (violation.key, violation.found) == ("gripper_width", "0.500 to 0.500")


def test_rotated_eef_frame_is_rotated_back(v0, made, tmp_path):
    """The EEF of RoboCAS-v0 is rotated by -90 deg about z, which the gripper camera reveals."""
    turn = Rotation.from_euler("z", -90, degrees=True)
    for number in (0, 1):
        episode = v0 / f"episode_{number:07d}"
        arrays = arrays_of(episode)
        change(
            episode,
            ee_orn=(Rotation.from_quat(arrays["ee_orn"]) * turn).as_quat(),
            rel_pos=turn.inv().apply(arrays["rel_pos"]),
            rel_orn=(turn.inv() * Rotation.from_quat(arrays["rel_orn"]) * turn).as_quat(),
        )
        path = episode / "gripper_camera" / "cam_pos_wrt_ee.npy"
        pose = np.load(path)
        pose[:3] = turn.inv().as_matrix() @ pose[:3]
        np.save(path, pose)
    for turned in (False, True):  # also as it is the cameras agree with the arrays
        new = imported(v0, tmp_path / f"out {turned}", turn_eef=turned)
        assert validate(new.root).violations == []
    for number in (0, 1):
        a, b = new.episode(number), Dataset(made).episode(number)
        same = np.abs(np.sum(a.arrays["ee_orn"] * b.arrays["ee_orn"], axis=1))
        np.testing.assert_allclose(same, 1, atol=1e-6)
        np.testing.assert_allclose(a.arrays["rel_pos"], b.arrays["rel_pos"], atol=1e-6)
        poses = [episode.camera_in_parent("gripper_camera") for episode in (a, b)]
        np.testing.assert_allclose(*poses, atol=1e-9)


@pytest.mark.parametrize(
    ("new", "key", "found"),
    [
        ({"ee_pos": np.zeros((6, 3), np.float32)}, "rel_pos", "shape (7, 3)"),
        ({"arm_joint_vel": np.zeros((6, 7), np.float32)}, "arm_joint_vel", "shape (6, 7)"),
        ({"ee_pos": np.full((7, 3), np.nan)}, "ee_pos", "21 NaN or infinite values"),
        ({"ee_orn": np.full((7, 4), 0.6)}, "ee_orn", "off by 0.2 in row 0"),
        ({"rel_pos": np.ones((7, 3))}, "rel_pos", "7 of 7 rows off"),
        ({"gripper_status": np.full(7, 0.3)}, "gripper_status", "float64, not bool"),
        ({"gripper_status": None}, "gripper_status", "no such key"),
        ({"ee_pos": np.zeros(7)}, "ee_pos", "1 axes, not 2"),
        ({"ee_orn": np.array(["x"] * 7)}, "ee_orn", "1 axes, not 2"),
    ],
)
def test_invalid_arrays_skip_their_episode(v0, tmp_path, new, key, found):
    change(v0 / "episode_0000001", **new)
    assert any(
        (episode, where) == (1, f"{NPZ}, {key}") and text.startswith(found)
        for episode, where, text, _ in problems(v0, "skipped")
    )
    report = survey_dataset(v0).as_json()
    assert (report["skipped"], report["importable"]) == ([1], 1)
    json.dumps(report)
    out = imported(v0, tmp_path / "out")
    assert out.numbers == [0]
    assert validate(out.root).violations == []


def test_missing_arrays_are_reported(v0, tmp_path):
    change(v0 / "episode_0000001", base_pos=None, robot_joints=None, arm_joint_vel=None)
    new = imported(v0, tmp_path / "out")
    missing = ["robot_joints", "arm_joint_vel", "base_pos", "agv_pose", "rel_agv_pose"]
    assert new.episode(1).scene["source"]["missing"] == missing
    assert (1, f"{NPZ}, base_pos", "no such key", "can't be derived") in problems(v0, "warning")
    assert {violation.key for violation in validate(new.root).violations} == set(missing)


def embed(texts):
    vectors = np.zeros((len(texts), 384), np.float32)
    vectors[range(len(texts)), [sum(map(ord, text)) % 384 for text in texts]] = 1
    return vectors


def test_embeddings_are_kept_removed_or_computed(dataset, made, tmp_path):
    (dataset / "conversion.json").unlink()
    assert imported(dataset, tmp_path / "all").settings["embeddings"] is True
    change(dataset / "episode_0000000", language_embedding=np.ones(512, np.float32))
    assert (0, f"{NPZ}, language_embedding", "shape (512,)", "not imported") in problems(dataset, "warning")
    assert (None, f"{NPZ}, embeddings", "1 episode without", "not imported") in problems(dataset, "repaired")
    assert imported(dataset, tmp_path / "none").settings["embeddings"] is False
    assert validate(tmp_path / "none").violations == []
    import_robocas(survey_dataset(dataset), tmp_path / "made", embed=embed)
    assert validate(tmp_path / "made").violations == []
    new = Dataset(tmp_path / "made")
    assert new.settings["embeddings"] is True
    arrays = new.episode(0).arrays
    np.testing.assert_array_equal(arrays["step_goal_embs"], embed(arrays["step_lang_goals"].tolist()))
    old, now = (arrays_of(root / "episode_0000001")["step_goal_embs"] for root in (made, new.root))
    np.testing.assert_array_equal(old, now)  # those that are there stay
    assert set(new.episode(0).scene["source"]["derived"]) == {"language_embedding", "step_goal_embs"}


def test_damaged_dataset_keeps_its_scenes(dataset, made, tmp_path):
    (dataset / "episode_0000000" / "base_camera" / "rgb" / "0000.png").unlink()
    new = imported(dataset, tmp_path / "out")
    assert new.numbers == [1]
    before, scene = (read(root / "episode_0000001" / "scene.json") for root in (made, new.root))
    assert scene["source"].items() >= before["source"].items()
    assert {**scene, "source": None} == {**before, "source": None}
    assert new.settings["episodes"]["1"]["seed"] == 5
    assert validate(new.root).violations == []


def test_no_importable_episode(copy, tmp_path, capsys):
    for path in copy.glob("*/episode_info.npz"):
        path.write_bytes(b"")
    with pytest.raises(DatasetError, match="no episode can be imported"):
        imported(copy, tmp_path / "out")
    assert run(["import-robocas", str(copy), "--out", str(tmp_path / "out")]) == 1
    assert "4 episodes, 0 can be imported, 4 skipped" in capsys.readouterr().out
    assert not (tmp_path / "out").exists()


def test_command(copy, tmp_path, capsys):
    root, out = copy, tmp_path / "out"
    change(root / "episode_0000002", rel_pos=np.zeros((7, 3)))
    assert run(["import-robocas", str(root)]) == 0
    text = capsys.readouterr().out
    assert "4 episodes, 3 can be imported, 1 skipped" in text
    assert "derived from base_pos, base_orn" in " ".join(text.split())
    assert run(["import-robocas", str(root), "--out", str(out), "--json", "--link"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["skipped"] == [2]
    assert report == read(out / "import_report.json")
    image = "episode_0000001/base_camera/rgb/0003.png"
    assert (root / image).stat().st_ino == (out / image).stat().st_ino
    assert run(["import-robocas", str(root), "--out", str(out)]) == 0
    assert "3 episodes, 3 already there" in capsys.readouterr().out
    assert run(["import-robocas", str(root), "--out", str(out), "--rate", "10"]) == 1
    assert "rate_hz: 5.0 -> 10.0" in capsys.readouterr().err
