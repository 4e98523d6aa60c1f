"""Page content of trajectories and datasets."""

import json
import shutil

import numpy as np
import pytest
from synthetic import STEPS, RayCaster, make_states, write_trajectory

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets.conversion.convert import convert
from robocas_ms3.datasets.conversion.settings import ConversionSettings
from robocas_ms3.datasets.sources.reader import Dataset
from robocas_ms3.viewer.episode import make_base_plot, make_plot, make_signs_continuous, round_values
from robocas_ms3.viewer.source import open_content

ROW = {"n", "steps", "instruction", "task", "object", "seed", "success", "split", "stages", "attempts", "damage"}
CAMERAS = ("base_camera", "gripper_camera", "static_camera")
EPISODE = {"n", "instruction", "steps", "times", "subgoals", "plots", "trace", "facts", "failures"}


def series(episode, title):
    (found,) = [p for p in episode["plots"] if p["title"].startswith(title)]
    return np.column_stack([s["values"] for s in found["series"]])


def test_numbers_are_rounded_and_nan_becomes_none():
    assert round_values([[1.000001, -0.000001]]) == [[1.0, 0.0]]
    assert str(round_values([-0.000001])) == "[0.0]"
    assert round_values([0.5, np.nan, np.inf]) == [0.5, None, None]
    assert make_plot("p", "m", ("x",), np.array([[1.0], [2.0]]))["series"] == [{"name": "x", "values": [1.0, 2.0]}]


def test_camera_names_with_slashes_are_omitted(folder):
    page = open_content(folder)
    page.source.cameras = ("base_camera", "..", "../x", "a/b", "", "cam-1.left", "x" * 81)
    assert page.index()["cameras"] == ["base_camera", "cam-1.left"]


def test_orientation_and_yaw_are_continuous():
    turn = np.array([[0.0, 0, 0, 1], [0, 0, -0.1, -0.995], [0, 0, 0.2, 0.98]])
    expected = [[0, 0, 0, 1], [0, 0, 0.1, 0.995], [0, 0, 0.2, 0.98]]
    assert (
        make_signs_continuous(turn).tolist() == make_signs_continuous(-turn).tolist() == expected
    )  # for both signs at the start
    (base,) = make_base_plot(np.array([[0, 0, 3.1], [0, 0, -3.1]]))
    assert base["series"][2]["values"] == [3.1, round(2 * np.pi - 3.1, 5)]
    assert make_base_plot(np.ones((3, 3))) == []


@pytest.mark.parametrize("made", ["run_folder", "folder"])  # the run's folder is its trajectory
def test_episodes_and_skipped_seeds_are_listed(request, made):
    index = open_content(request.getfixturevalue(made)).index()
    assert index == json.loads(json.dumps(index, allow_nan=False))
    rows = {key: [row[key] for row in index["episodes"]] for key in ROW}
    assert rows["n"] == [0, 1, 2, None]
    assert rows["seed"] == [3, 4, 5, 9]
    assert rows["success"] == [True, False, True, False]
    assert rows["stages"] == [[], ["grasp"], [], ["reach"]]
    assert rows["attempts"] == [None, 2, None, 1]
    assert rows["task"] == ["pick"] * 4
    assert rows["object"] == ["cube 3 (cube)", "cube 4 (cube)", "cube 5 (cube)", ""]
    if made == "folder":
        assert (index["cameras"], index["depth"], index["rate_hz"], index["note"]) == (list(CAMERAS), True, 5, "")
        assert sorted(rows["split"]) == ["", "train", "train", "val"]
    else:
        assert (index["cameras"], index["depth"], index["rate_hz"]) == ([], False, 20)
        assert "`robocas convert trajectory.h5" in index["note"]


def test_an_episode_of_a_trajectory(run_folder):
    episode = open_content(run_folder / "trajectory.h5").episode(1)
    states = make_states(4)
    assert set(episode) == EPISODE
    steps = STEPS + 1
    assert episode["steps"] == len(episode["times"]) == steps
    assert episode["times"][-1] == pytest.approx(STEPS / 20)
    assert all(len(s["values"]) == steps for p in episode["plots"] for s in p["series"])
    robot = states["articulations"]["robocas_mobile_panda"]
    np.testing.assert_allclose(series(episode, "Arm joints"), robot[:, 16:23], atol=1e-5)
    np.testing.assert_allclose(series(episode, "Gripper")[:, 0], robot[:, 23:25].sum(axis=1) * 1000, atol=1e-4)
    np.testing.assert_allclose(series(episode, "Action: arm")[:-1], robot[1:, 16:23], atol=1e-5)
    np.testing.assert_allclose(series(episode, "Action: gripper")[:, 0], [1] * 9 + [-1] * (steps - 9))
    # sub-goals cover all states, the last one too
    assert [(g["first"], g["last"]) for g in episode["subgoals"]] == [(0, 11), (12, steps - 1)]
    objects = {thing["name"]: thing for thing in episode["trace"]["objects"]}
    assert set(objects) == {"cube 4 (cube)", "object 1", "object 2"}
    assert [name for name, thing in objects.items() if thing["target"]] == ["cube 4 (cube)"]
    assert len(objects["cube 4 (cube)"]["path"]) == steps  # it is lifted
    assert len(objects["object 1"]["path"]) == 1  # it stands
    assert objects["cube 4 (cube)"]["path"][-1][2] == pytest.approx(0.66 + 0.1, abs=1e-4)
    assert episode["trace"]["moving"]
    assert [(f["stage"], f["reason"]) for f in episode["failures"]] == [("grasp", "slipped")]


def test_objects_have_the_same_names_in_recording_and_dataset(run_folder, folder, tmp_path):
    """By name and id; objects of a missing pack by id."""
    recorded = shutil.copytree(run_folder, tmp_path / "run") / "trajectory.json"
    metadata = json.loads(recorded.read_text())
    metadata["episodes"][0]["robocas"]["objects"] = ["cube", "toy_airplane_c", "some_thing"]
    recorded.write_text(json.dumps(metadata))
    converted = shutil.copytree(folder, tmp_path / "dataset") / "episode_0000000" / "scene.json"
    scene = json.loads(converted.read_text())
    scene["objects"][1] |= {"id": "toy_airplane_c", "name": "white toy airplane"}
    scene["layout"]["poses"] = [[0.1 * slot, 0, 0.7, 1, 0, 0, 0] for slot in range(3)]
    converted.write_text(json.dumps(scene))
    for path, others in ((recorded.with_suffix(".h5"), {"some thing"}), (converted.parents[1], {"cube"})):
        called = {thing["name"] for thing in open_content(path).episode(0)["trace"]["objects"]}
        assert called - {"cube 3 (cube)"} == {"white toy airplane (toy airplane c)"} | others


def test_unlisted_episode_has_no_split(folder, tmp_path):
    """As after an interrupted conversion."""
    other = shutil.copytree(folder, tmp_path / "other")
    info = json.loads((other / "data_info.json").read_text())
    for train, val, shown in (([0], [2], ["train", "", "val"]), ([], [], [""] * 3), (["x"], 3, [""] * 3)):
        (other / "data_info.json").write_text(json.dumps({**info, "train_eps": train, "val_eps": val}))
        assert [row["split"] for row in open_content(other).index()["episodes"]] == [*shown, ""]


def test_an_episode_of_a_folder(folder):
    episode, arrays = open_content(folder).episode(1), Dataset(folder).episode(1).arrays
    assert set(episode) == EPISODE
    np.testing.assert_allclose(series(episode, "TCP position"), arrays["ee_pos"], atol=1e-5)
    np.testing.assert_allclose(series(episode, "Action: TCP translation"), arrays["rel_pos"] * 1000, atol=1e-5)
    np.testing.assert_allclose(series(episode, "Gripper")[:, 1], np.where(arrays["gripper_status"], 80, 0))
    assert episode["subgoals"][0]["first"] == 0
    assert episode["subgoals"][-1]["last"] == 6
    assert len(episode["trace"]["tcp"]) == 7
    assert [f["stage"] for f in episode["failures"]] == ["grasp"]


def test_failures_belong_to_their_environment(run_folder, folder, tmp_path):
    """Seeds 4 and 9 failed in one task; episodes of another task with these seeds are unrelated."""
    other = write_trajectory(tmp_path / "trajectory.h5", seeds=(4, 9), steps=24)
    metadata = json.loads(other.with_suffix(".json").read_text())
    metadata["env_info"]["env_id"] = "robocas_ms3:RoboCASOpenPick-v1"
    other.with_suffix(".json").write_text(json.dumps(metadata))
    slipped = {"seed": 4, "attempt": 1, "stage": "pull", "reason": "slipped", "seconds": 1.0}
    (tmp_path / "failures.jsonl").write_text(json.dumps(slipped))
    both = shutil.copytree(folder, tmp_path / "both")
    (both / "failures.jsonl").unlink()
    for path in (run_folder / "trajectory.h5", other):
        settings = {"open_renderer": RayCaster, "embeddings": False, "video": False, "include_failed": True}
        convert(ConversionSettings(path, both, append=True, **settings))
    for scene in both.glob("*/scene.json"):  # the frames' source has one task
        change = {"task": "open_pick"} if "OpenPick" in scene.read_text() else {}
        scene.write_text(json.dumps({**json.loads(scene.read_text()), **change}))
    source = open_content(both)
    rows = source.index()["episodes"]
    assert [(row["n"], row["seed"]) for row in rows] == [(0, 3), (1, 4), (2, 5), (3, 4), (4, 9), (None, 9)]
    assert [row["stages"] for row in rows] == [[], ["grasp"], [], ["pull"], [], ["reach"]]
    assert [row["task"] for row in rows] == ["pick"] * 3 + ["open_pick"] * 2 + ["pick"]
    assert [len(source.episode(n)["failures"]) for n in range(5)] == [0, 1, 0, 1, 0]


def test_v0_folder_is_shown(folder, tmp_path):
    bare = shutil.copytree(folder, tmp_path / "bare")
    for path in (*bare.glob("*.json*"), *bare.glob("*/scene.json")):
        path.unlink()
    source = open_content(bare)
    (row, *_) = source.index()["episodes"]
    assert (row["steps"], row["success"], row["seed"], row["split"]) == (7, None, None, "")
    episode = source.episode(0)
    assert episode["trace"]["objects"] == []
    assert episode["instruction"].startswith("grasp the cube 3")


def test_link_to_a_file_outside_is_refused(folder, tmp_path):
    spoilt = shutil.copytree(folder, tmp_path / "spoilt")
    secret = tmp_path / "secret.png"
    secret.write_bytes(b"secret")
    for kind in ("rgb", "depth"):
        path = spoilt / f"episode_0000001/base_camera/{kind}/0002.png"
        path.unlink()
        path.symlink_to(secret)
    source = open_content(spoilt)
    for read in (source.rgb, source.depth):
        with pytest.raises(DatasetError, match="outside the dataset"):
            read(1, "base_camera", 2)


def test_nothing_to_view(tmp_path):
    (tmp_path / "notes.txt").write_text("hello")
    for path in (tmp_path, tmp_path / "notes.txt", tmp_path / "x"):
        with pytest.raises(DatasetError):
            open_content(path)
