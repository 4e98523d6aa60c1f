"""Datasets in upstream's format: made of ours by taking away, renaming and retyping."""

import json
import shutil

import cv2
import numpy as np
import pytest
from managing import arrays_of, change, die, edit, files_of, make, read
from scipy.spatial.transform import Rotation

from robocas_ms3.cli.main import run
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.words import format_ranges
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.checks.dataset import validate
from robocas_ms3.datasets.manage.importing import import_robocas
from robocas_ms3.datasets.manage.repairs import eef_turn
from robocas_ms3.datasets.manage.survey import survey
from robocas_ms3.datasets.pictures.video import contact_sheet
from robocas_ms3.datasets.sources.reader import Dataset
from robocas_ms3.datasets.sources.records import SCENE_KEYS

OURS = ("agv_pose", "rel_agv_pose")


def as_upstream(root, pose_name="cam_pos_wrt"):
    """Leave what upstream writes, with one name of the cameras' poses."""
    for path in [root / "conversion.json", *root.glob("*/scene.json")]:
        path.unlink()
    for path in root.glob("episode_*"):
        change(path, **dict.fromkeys((*OURS, "language_embedding", "step_goal_embs")))
    for path in root.glob("*/*/cam_pos*"):
        if not path.name.startswith(pose_name):
            path.unlink()
    return root


@pytest.fixture
def upstream(dataset):
    return as_upstream(dataset)


@pytest.fixture(scope="module")
def four(tmp_path_factory):
    """Four episodes as upstream writes them, that nobody may change."""
    return as_upstream(make(tmp_path_factory.mktemp("four"), "four", range(4)))


def problems(root, **kwargs):
    return [(f.episode, f.file.split("/", 1)[-1], f.problem, f.outcome) for f in survey(root, **kwargs).findings]


NO_SCENE = "no file: seed, target, layout and configuration are not known"


def test_files_that_are_missing_everywhere_are_told_once(four, tmp_path):
    root = shutil.copytree(four, tmp_path / "four")
    found = [(f.episode, f.file, f.problem, f.outcome) for f in survey(root).findings if f.episode is None]
    assert found == [
        (None, "conversion.json", "no file: made of the episodes, 5 steps a second", "mended"),
        (None, "scene.json", NO_SCENE, "noted"),
        *(
            (None, f"{camera}/cam_pose_wrt_{parent}.npy", f"no file: a copy of cam_pos_wrt_{parent}.npy", "mended")
            for camera, parent in (("base_camera", "arm_base"), ("gripper_camera", "ee"), ("static_camera", "world"))
        ),
    ]
    poses = root / "episode_0000002" / "static_camera"
    shutil.copy(poses / "cam_pos_wrt_world.npy", poses / "cam_pose_wrt_world.npy")
    found = [f for f in survey(root).findings if "static_camera" in f.file]
    assert [(f.episode, f.file) for f in found] == [
        (n, f"episode_000000{n}/static_camera/cam_pose_wrt_world.npy") for n in (0, 1, 3)
    ]


def test_a_whole_dataset_of_ours_has_no_findings(made):
    assert survey(made).findings == []


def test_the_output_is_the_input(four, capsys):
    for out in (four, four / "inside", four.parent):
        assert run(["import-robocas", str(four), "--out", str(out)]) == 1
        text = capsys.readouterr().err
        assert "the output is an input" in text
        assert "--overwrite" not in text


def imported(root, out, **kwargs):
    import_robocas(survey(root, **kwargs), out)
    return Dataset(out)


@pytest.mark.parametrize("pose_name", ["cam_pos_wrt", "cam_pose_wrt"])
def test_what_upstream_writes_becomes_a_valid_dataset(dataset, made, tmp_path, pose_name):
    root, out = as_upstream(dataset, pose_name), tmp_path / "out"
    before = files_of(root)
    new = imported(root, out)
    assert validate(out).violations == []
    assert new.info == read(made / "data_info.json")
    assert new.settings["embeddings"] is False
    for number in (0, 1):
        name = f"episode_{number:07d}"
        old, now = arrays_of(made / name), arrays_of(out / name)
        assert list(now) == [spec.name for spec in schema.EPISODE_INFO if not spec.embedding]
        for key, array in now.items():
            if array.dtype.kind == "f":
                np.testing.assert_allclose(array, old[key], atol=1e-6)
            else:
                np.testing.assert_array_equal(array, old[key])
        for path in (made / name).glob("*/*"):
            if path.suffix == ".npy":
                np.testing.assert_array_equal(np.load(out / path.relative_to(made)), np.load(path))
        for path in (made / name).glob("*/*/*.png"):
            assert (out / path.relative_to(made)).read_bytes() == path.read_bytes()
        scene = new.episode(number).scene
        assert list(scene) == list(SCENE_KEYS)
        assert {key for key, value in scene.items() if value is not None} == {"schema_version", "rate_hz", "source"}
        assert scene["source"]["format"] == "robocas v0"
        assert scene["source"]["derived"] == {"agv_pose": "base_pos, base_orn", "rel_agv_pose": "agv_pose"}
    assert read(out / "import_report.json")["taken"] == 2
    contact_sheet(Dataset(out), tmp_path / "sheet.png")
    assert files_of(root) == before


def test_other_types_and_axes(upstream, made, tmp_path):
    episode = upstream / "episode_0000000"
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
    np.testing.assert_array_equal(Dataset(upstream).episode(0).intrinsic("base_camera"), intrinsic)
    new = imported(upstream, tmp_path / "out")
    assert validate(new.root).violations == []
    assert (0, "episode_info.npz, speed", "an unknown key: not taken", "noted") in problems(upstream)
    old = arrays_of(made / "episode_0000000")
    for key in ("ee_pos", "gripper_width", "gripper_status", "language_goal", "step_goal_type", "episode_length"):
        np.testing.assert_array_equal(new.episode(0).arrays[key], old[key])


class Bomb:
    """Unpickling this is noticed."""

    def __reduce__(self):
        return exec, ("raise SystemExit('unpickled')",)


def test_pickles_are_never_loaded(upstream, tmp_path):
    goals = np.empty(7, object)
    goals[:] = [Bomb() for _ in range(7)]
    joints = np.empty(7, object)
    joints[:] = [Bomb() for _ in range(7)]
    change(upstream / "episode_0000000", robot_joints=joints)
    change(upstream / "episode_0000001", step_lang_goals=goals, speed=joints)
    pickled = "pickled objects, which are never loaded"
    with pytest.raises(DatasetError, match=f"robot_joints: this array can't be read .found {pickled}"):
        _ = Dataset(upstream).episode(0).arrays
    found = problems(upstream)
    assert (0, "episode_info.npz, robot_joints", pickled, "left out") in found
    # Texts are in data_info.json, too.
    text = f"{pickled}; made of data_info.json"
    assert (1, "episode_info.npz, step_lang_goals", text, "mended") in found
    new = imported(upstream, tmp_path / "out")
    assert new.numbers == [1]
    assert validate(new.root).violations == []


def test_relative_motion_as_the_paper_writes_it(upstream, made, tmp_path):
    episode = upstream / "episode_0000001"
    arrays = arrays_of(episode)
    change(episode, **{key: np.roll(arrays[key], 1, axis=0) for key in ("rel_pos", "rel_orn")})
    found = problems(upstream)
    text = "was stored one step later, as the paper writes it"
    assert (1, "episode_info.npz, rel_pos, rel_orn", text, "mended") in found
    new = imported(upstream, tmp_path / "out")
    np.testing.assert_allclose(
        new.episode(1).arrays["rel_pos"], arrays_of(made / "episode_0000001")["rel_pos"], atol=1e-6
    )
    assert f"episode_info.npz, rel_pos, rel_orn: {text}" in new.episode(1).scene["source"]["mended"]


def test_quaternions_wxyz(upstream, tmp_path):
    for episode in upstream.glob("episode_*"):
        arrays = arrays_of(episode)
        keys = ("ee_orn", "rel_orn", "base_orn", "base_rel_orn")
        change(episode, **{key: np.roll(arrays[key], 1, axis=1) for key in keys})
    assert (0, "episode_info.npz, rel_pos, rel_orn", "quaternions were wxyz", "mended") in problems(upstream)
    imported(upstream, tmp_path / "out")
    assert validate(tmp_path / "out").violations == []


def test_values_that_are_taken_as_they_are(upstream, tmp_path):
    widths = arrays_of(upstream / "episode_0000000")["gripper_width"]
    change(upstream / "episode_0000000", gripper_width=np.full_like(widths, 0.5))
    found = (0, "episode_info.npz, gripper_width", "0.500 to 0.500, not -0.005 to 0.085 m", "noted")
    assert found in problems(upstream)
    assert imported(upstream, tmp_path / "out").numbers == [0, 1]
    (violation,) = validate(tmp_path / "out").violations
    assert (violation.key, violation.found) == ("gripper_width", "0.500 to 0.500")


@pytest.mark.parametrize("degrees", [-90])
def test_a_turned_eef_frame_is_turned_back(upstream, made, tmp_path, degrees):
    """Upstream's TCP is ManiSkill's turned by -90 deg about z; the gripper camera's place tells."""
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    for number in (0, 1):
        episode = upstream / f"episode_{number:07d}"
        arrays = arrays_of(episode)
        quaternion = Rotation.from_euler("z", degrees, degrees=True)
        change(
            episode,
            ee_orn=(Rotation.from_quat(arrays["ee_orn"]) * quaternion).as_quat(),
            rel_pos=quaternion.inv().apply(arrays["rel_pos"]),
            rel_orn=(quaternion.inv() * Rotation.from_quat(arrays["rel_orn"]) * quaternion).as_quat(),
        )
        path = episode / "gripper_camera" / "cam_pos_wrt_ee.npy"
        np.save(path, np.linalg.inv(turn) @ np.load(path))
    for turned in (False, True):  # also as it is the cameras agree with the arrays
        out = tmp_path / f"out {turned}"
        new = imported(upstream, out, turn_eef=turned)
        assert validate(out).violations == []
    ours = Dataset(made)
    for number in (0, 1):
        a, b = new.episode(number), ours.episode(number)
        same = np.abs(np.sum(a.arrays["ee_orn"] * b.arrays["ee_orn"], axis=1))
        np.testing.assert_allclose(same, 1, atol=1e-6)
        np.testing.assert_allclose(a.arrays["rel_pos"], b.arrays["rel_pos"], atol=1e-6)
        np.testing.assert_allclose(
            a.camera_in_parent("gripper_camera"), b.camera_in_parent("gripper_camera"), atol=1e-9
        )


def test_a_recorded_episode_is_not_turned_wherever_its_camera_is(dataset):
    def turned():
        return [finding.episode for finding in survey(dataset).findings if "ee_orn" in finding.file]

    (dataset / "conversion.json").unlink()
    folder = dataset / schema.episode_folder(1)
    pose = np.load(folder / "gripper_camera" / "cam_pos_wrt_ee.npy")
    pose[:2, 3] = 0, 0.05
    np.save(folder / "gripper_camera" / "cam_pos_wrt_ee.npy", pose)
    assert turned() == []
    scene = json.loads((folder / "scene.json").read_text())
    (folder / "scene.json").write_text(json.dumps({**scene, "env_info": None}))  # as of a dataset made elsewhere
    assert turned() == [1]


def test_the_turn_by_hand():
    def camera_at(x, y):
        pose = np.eye(4)
        pose[:2, 3] = x, y
        return pose

    assert [eef_turn(camera_at(x, y)) for x, y in ((0.05, 0), (0, 0.05), (-0.05, 0), (0, -0.05))] == [0, 90, 180, -90]
    assert eef_turn(camera_at(0, 0.2)) == 0  # not the known camera
    assert eef_turn(camera_at(0.04, 0.04)) == 0


@pytest.mark.parametrize(
    ("new", "file", "problem"),
    [
        ({"ee_pos": np.zeros((6, 3), np.float32)}, "rel_pos", "shape (7, 3), not (6, 3)"),
        ({"arm_joint_vel": np.zeros((6, 7), np.float32)}, "arm_joint_vel", "shape (6, 7), not (7, 7)"),
        ({"ee_pos": np.full((7, 3), np.nan)}, "ee_pos", "21 numbers that are NaN or infinite"),
        ({"ee_orn": np.full((7, 4), 0.6)}, "ee_orn", "not of unit length: off by 0.2"),
        ({"rel_pos": np.ones((7, 3))}, "rel_pos, rel_orn", "not the motion of ee_pos, ee_orn: 7 of 7 rows differ"),
        ({"gripper_status": np.full(7, 0.3)}, "gripper_status", "float64, not bool"),
        ({"gripper_status": None}, "gripper_status", "missing"),
        ({"ee_pos": np.zeros(7)}, "ee_pos", "1 axes, not 2"),
        ({"ee_orn": np.array(["x"] * 7)}, "ee_orn", "1 axes, not 2"),
    ],
)
def test_bad_arrays_leave_their_episode_out(upstream, tmp_path, new, file, problem):
    change(upstream / "episode_0000001", **new)
    found = problems(upstream)
    assert (1, f"episode_info.npz, {file}", problem, "left out") in found
    report = survey(upstream).as_json()
    assert (report["left_out"], report["taken"]) == ([1], 1)
    json.dumps(report)
    out = imported(upstream, tmp_path / "out")
    assert out.numbers == [0]
    assert validate(out.root).violations == []


def test_arrays_that_can_not_be_made_are_told(upstream, tmp_path):
    change(upstream / "episode_0000001", base_pos=None, robot_joints=None, arm_joint_vel=None)
    new = imported(upstream, tmp_path / "out")
    missing = ["robot_joints", "arm_joint_vel", "base_pos", "agv_pose", "rel_agv_pose"]
    assert new.episode(1).scene["source"]["missing"] == missing
    assert (1, "episode_info.npz, base_pos", "missing, and can't be made", "noted") in problems(upstream)
    violations = [str(v) for v in validate(new.root).violations]  # the dataset is not whole, and that is said
    assert {v.split(", ")[1].split(":")[0] for v in violations} == set(missing)


def test_pictures_that_are_missing_or_damaged(four, tmp_path):
    root = shutil.copytree(four, tmp_path / "four")
    rgb = root / "episode_0000001" / "base_camera" / "rgb"
    (rgb / "0002.png").unlink()
    data = (rgb / "0003.png").read_bytes()
    (rgb / "0003.png").write_bytes(data[: len(data) // 2])
    shutil.rmtree(root / "episode_0000002" / "static_camera" / "depth")
    depth = root / "episode_0000003" / "gripper_camera" / "depth"
    shutil.copy(depth / "0006.png", depth / "0007.png")
    found = problems(root)
    assert (1, "base_camera/rgb/0002.png", "missing", "left out") in found
    assert (1, "base_camera/rgb/0003.png", "PNG cut off", "left out") in found
    assert (2, "static_camera/depth/0000.png", "missing", "left out") in found
    assert (2, "static_camera/depth", "4 more are missing or damaged", "left out") in found
    assert (3, "gripper_camera/depth", "1 file beyond the 7 steps: not taken", "noted") in found
    new = imported(root, tmp_path / "out")
    assert new.numbers == [0, 3]
    assert validate(new.root).violations == []


def test_pictures_of_another_kind(four, tmp_path):
    root = shutil.copytree(four, tmp_path / "four")
    for path in (root / "episode_0000000").glob("*/depth/*.png"):
        cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_UNCHANGED).astype(np.uint8))
    for path in (root / "episode_0000001").glob("*/*/*.png"):
        cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[:40])
    found = problems(root)
    assert (0, "base_camera/depth/0000.png", "1 x 8 bit, not 1 x 16 bit", "left out") in found
    cameras = "base_camera, gripper_camera, static_camera"
    text = f"pictures of {cameras}, 64 x 40 png, with depth; most are of {cameras}, 64 x 48 png, with depth"
    assert (1, "episode_0000001", text, "left out") in found
    assert imported(root, tmp_path / "out").numbers == [2, 3]


def test_cameras(four, tmp_path):
    root = shutil.copytree(four, tmp_path / "four")
    (root / "episode_0000000" / "base_camera" / "intrinsic.npy").unlink()
    (root / "episode_0000001" / "base_camera" / "cam_pos_wrt_arm_base.npy").unlink()
    np.save(root / "episode_0000002" / "static_camera" / "cam_pos_wrt_world.npy", np.ones((4, 4)))
    found = [problem for problem in problems(root) if problem[3] == "left out"]
    assert [(episode, file) for episode, file, *_ in found] == [
        (0, "base_camera"), (1, "base_camera"), (2, "static_camera")
    ]  # fmt: skip
    assert found[1][2] == "no pose of this camera"
    assert found[2][2] == "its pose is not a rigid transform"


def test_rgb_alone_and_fewer_cameras(four, tmp_path):
    root = shutil.copytree(four, tmp_path / "four")
    for path in root.glob("*/static_camera"):
        shutil.rmtree(path)
    for path in root.glob("*/*/depth"):
        shutil.rmtree(path)
    new = imported(root, tmp_path / "out")
    assert (new.settings["cameras"], new.settings["depth"]) == (["base_camera", "gripper_camera"], False)
    assert validate(new.root).violations == []
    contact_sheet(new, tmp_path / "sheet.png")


def test_the_overview(four, tmp_path):
    root = shutil.copytree(four, tmp_path / "four")

    def spoil(info):
        info["train_eps"] = [0, 7, 0]
        info["val_eps"] = [2]
        info["ep_length"]["0"] = 9
        info["language_goal"]["2"] = "dance"

    edit(root / "data_info.json", spoil)
    found = [problem for problem in problems(root) if problem[0] is not None and "made of" not in problem[2]]
    assert [(episode, problem) for episode, _, problem, _ in found] == [
        (0, "listed twice: it trains"),
        (0, "data_info.json says 9, this 7"),
        (1, "not listed: added"),
        (2, "data_info.json says 'dance', this 'grasp the cube 2 on the table and move it to the basket'"),
        (3, "not listed: added"),
        (7, "listed, but there is no such folder"),
    ]
    new = imported(root, tmp_path / "out")
    assert 2 in new.info["val_eps"]
    assert 0 in new.info["train_eps"]
    assert validate(new.root).violations == []
    (root / "data_info.json").write_text("{")
    assert problems(root)[0][:2] == (None, "data_info.json")
    assert validate(imported(root, tmp_path / "again").root).violations == []


def test_an_episode_twice_of_which_the_first_can_not_be_taken(four, tmp_path):
    root = shutil.copytree(four, tmp_path / "four")
    shutil.copytree(root / "episode_0000001", root / "episode_0000009")
    for path in (root / "episode_0000001").glob("*/*/*.png"):
        cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[:40])
    assert sorted(survey(root).taken) == [0, 2, 3, 9]


def test_embeddings_of_all_or_none(dataset, tmp_path):
    (dataset / "conversion.json").unlink()
    assert imported(dataset, tmp_path / "all").settings["embeddings"] is True
    change(dataset / "episode_0000000", language_embedding=np.ones(512, np.float32))
    found = problems(dataset)
    assert (0, "episode_info.npz, language_embedding", "not taken: shape (512,), not (384,)", "noted") in found
    text = "missing in 1 episode: those of the others are not taken"
    assert (None, "episode_info.npz, embeddings", text, "mended") in found
    assert imported(dataset, tmp_path / "none").settings["embeddings"] is False
    assert validate(tmp_path / "none").violations == []


def test_embeddings_that_are_missing_can_be_made(dataset, made, tmp_path):
    (dataset / "conversion.json").unlink()
    change(dataset / "episode_0000000", language_embedding=None, step_goal_embs=None)

    def embed(texts):
        vectors = np.zeros((len(texts), 384), np.float32)
        vectors[range(len(texts)), [sum(map(ord, text)) % 384 for text in texts]] = 1
        return vectors

    out = tmp_path / "out"
    import_robocas(survey(dataset), out, embed=embed)
    assert validate(out).violations == []
    assert read(out / "conversion.json")["embeddings"] is True
    arrays = Dataset(out).episode(0).arrays
    np.testing.assert_array_equal(arrays["step_goal_embs"], embed(arrays["step_lang_goals"].tolist()))
    old, new = (arrays_of(root / "episode_0000001")["step_goal_embs"] for root in (made, out))
    np.testing.assert_array_equal(old, new)  # those that are there stay
    assert set(Dataset(out).episode(0).scene["source"]["derived"]) == {"language_embedding", "step_goal_embs"}


def test_ours_with_damage_keeps_what_it_says(dataset, made, tmp_path):
    (dataset / "episode_0000000" / "base_camera" / "rgb" / "0000.png").unlink()
    new = imported(dataset, tmp_path / "out")
    assert new.numbers == [1]
    before, scene = (read(root / "episode_0000001" / "scene.json") for root in (made, new.root))
    assert scene["source"].items() >= before["source"].items()
    assert {**scene, "source": None} == {**before, "source": None}
    assert new.settings["episodes"]["1"]["seed"] == 5
    assert validate(new.root).violations == []


def test_nothing_to_take(four, tmp_path, capsys):
    root = shutil.copytree(four, tmp_path / "four")
    for path in root.glob("*/episode_info.npz"):
        path.write_bytes(b"")
    with pytest.raises(DatasetError, match="no episode can be taken"):
        imported(root, tmp_path / "out")
    assert run(["import-robocas", str(root), "--out", str(tmp_path / "out")]) == 1
    assert "4 episodes, can be taken: 0, left out: 4" in capsys.readouterr().out
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("moment", ["file", "rename", "import overview"])
def test_killed_and_resumed_is_as_if_never_killed(four, tmp_path, moment):
    whole, out = tmp_path / "whole", tmp_path / "out"
    assert run(["import-robocas", str(four), "--out", str(whole)]) == 0
    die(moment, "import-robocas", four, "--out", out)
    assert run(["import-robocas", str(four), "--out", str(out)]) == 0
    assert files_of(out) == files_of(whole)


def test_command(four, tmp_path, capsys):
    root, out = shutil.copytree(four, tmp_path / "four"), tmp_path / "out"
    change(root / "episode_0000002", rel_pos=np.zeros((7, 3)))
    assert run(["import-robocas", str(root)]) == 0
    text = capsys.readouterr().out
    assert "4 episodes, can be taken: 3, left out: 1" in text
    assert "missing; made of base_pos, base_orn" in text
    assert run(["import-robocas", str(root), "--out", str(out), "--json", "--link"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["left_out"] == [2]
    assert report == read(out / "import_report.json")
    picture = "episode_0000001/base_camera/rgb/0003.png"
    assert (root / picture).stat().st_ino == (out / picture).stat().st_ino
    assert run(["import-robocas", str(root), "--out", str(out)]) == 0
    assert "3 episodes, 3 kept" in capsys.readouterr().out
    assert run(["import-robocas", str(root), "--out", str(out), "--rate", "10"]) == 1
    assert "rate_hz: 5.0 -> 10.0" in capsys.readouterr().err


def test_numbers_in_short():
    assert format_ranges([0, 1, 2, 5, 7, 8]) == "0-2, 5, 7-8"
    assert format_ranges([0, 2, 4, 6, 8, 10, 12, 13], most=3) == "0, 2, 4 and 5 more"
