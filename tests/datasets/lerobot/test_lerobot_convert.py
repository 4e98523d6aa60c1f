import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from lerobot_folders import convert, files_of
from synthetic import RayCaster, write_trajectory

pytest.importorskip("av", reason="needs the extra 'lerobot'")
pq = pytest.importorskip("pyarrow.parquet", reason="needs the extra 'lerobot'")

from robocas_ms3.cli import main
from robocas_ms3.core.errors import DatasetError, OutputExistsError, RobocasError
from robocas_ms3.datasets.lerobot import schema
from robocas_ms3.datasets.lerobot.check import check_lerobot
from robocas_ms3.datasets.lerobot.convert import convert_lerobot
from robocas_ms3.datasets.lerobot.reader import LeRobotDataset
from robocas_ms3.datasets.lerobot.schema import FileLimits
from robocas_ms3.datasets.sources.reader import Dataset
from robocas_ms3.datasets.sources.tolerant import arrays_fingerprint
from robocas_ms3.datasets.writing.inputs import open_input
from robocas_ms3.datasets.writing.settings import ConversionSettings


def test_the_folder_of_version_0_6(lerobot):
    expected = {
        "meta/info.json",
        "meta/stats.json",
        "meta/tasks.parquet",
        "meta/episodes/chunk-000/file-000.parquet",
        "meta/robocas/conversion.json",
        "meta/robocas/episodes.parquet",
        "meta/robocas/checksums.json",
        "data/chunk-000/file-000.parquet",
    }
    for camera in ("base", "gripper", "static"):
        expected.add(f"videos/observation.images.{camera}_camera/chunk-000/file-000.mp4")
        expected.add(f"videos/observation.images.{camera}_camera_depth/chunk-000/file-000.mp4")
    for number in (0, 1):
        expected |= {f".annotate_staging/episode_{number:06d}/{name}.jsonl" for name in ("plan", "vqa")}
    assert set(files_of(lerobot)) == expected
    info = json.loads((lerobot / "meta/info.json").read_text())
    assert info["codebase_version"] == "v3.0"
    assert (info["fps"], info["total_episodes"], info["total_frames"], info["total_tasks"]) == (5, 2, 14, 2)
    assert info["splits"] == {"train": "0:2"}
    video = info["features"]["observation.images.base_camera"]
    assert (video["dtype"], video["shape"], video["info"]["video.codec"]) == ("video", [48, 64, 3], "h264")
    # Every column but the videos, in the features' order, of their types: `datasets` casts by them.
    table = pq.read_table(lerobot / "data/chunk-000/file-000.parquet")
    assert table.column_names == [key for key, ft in info["features"].items() if ft["dtype"] != "video"]
    assert str(table.schema.field("action").type) == "fixed_size_list<element: float>[7]"
    assert table.column("index").to_pylist() == list(range(14))
    assert table.column("frame_index").to_pylist() == [*range(7), *range(7)]
    np.testing.assert_allclose(table.column("timestamp").to_pylist()[:7], np.arange(7) / 5, atol=1e-6)


def test_texts_of_version_0_5(trajectory, tmp_path):
    convert(trajectory, tmp_path / "out", lerobot_version="0.5")
    dataset = LeRobotDataset(tmp_path / "out")
    instructions = [f"grasp the cube {seed} on the table and move it to the basket" for seed in (3, 5)]
    assert dataset.tasks == instructions
    assert [row["tasks"] for row in dataset.rows] == [[text] for text in instructions]
    columns = dataset.episode(1).columns
    assert columns["task_index"].ravel().tolist() == [1] * 7
    subgoals = [dataset.subtasks[i] for i in columns["subtask_index"][:, 0]]
    assert subgoals == ["grasp the cube 5 on the table"] * 3 + ["Drop the cube 5 into the basket"] * 4
    types = dataset.episode(1).table.column("subgoal_type").to_pylist()
    assert types == ["move and grasp"] * 3 + ["transfer object"] * 4


def test_from_a_folder_as_from_the_trajectory(trajectory, made, tmp_path):
    """Nothing is rendered the second time, and it is the same but for where it comes from."""
    lerobot, out = tmp_path / "lerobot", tmp_path / "out"
    convert(trajectory, lerobot, lerobot_version="0.5")
    convert_lerobot(ConversionSettings(made, out, open_renderer=None, lerobot_version="0.5"))  # type: ignore[arg-type]
    before, after = files_of(lerobot), files_of(out)
    different = {name for name in before if before[name] != after.get(name)}
    assert different == {"meta/robocas/conversion.json", "meta/robocas/episodes.parquet"}
    assert set(before) == set(after)
    assert LeRobotDataset(out).episode(1).scene == Dataset(made).episode(1).scene


def test_and_back(made, tmp_path):
    convert(made, tmp_path / "out", codec="av1")
    dataset, source = LeRobotDataset(tmp_path / "out"), Dataset(made)
    assert dataset.info["features"]["observation.images.base_camera"]["info"]["video.codec"] == "av1"
    for number in source.numbers:
        ours, theirs = dataset.episode(number), source.episode(number)
        for key, values in ours.arrays.items():
            if values.dtype.kind == "f":
                np.testing.assert_allclose(values, theirs.arrays[key], atol=1e-6, err_msg=key)
            else:
                np.testing.assert_array_equal(values, theirs.arrays[key], err_msg=key)
        for key in ("ee_pos", "ee_orn", "robot_joints", "arm_joint_vel", "base_pos", "agv_pose", "rel_pos"):
            np.testing.assert_array_equal(ours.arrays[key], theirs.arrays[key], err_msg=key)
        for camera in ours.cameras:
            np.testing.assert_array_equal(ours.intrinsic(camera), theirs.intrinsic(camera))
            np.testing.assert_array_equal(ours.camera_in_parent(camera), theirs.camera_in_parent(camera))
            for step in (0, 3, 6):  # bit for bit, whatever the order
                within = np.minimum(theirs.depth(camera, step), schema.MAX_DEPTH_MM)
                np.testing.assert_array_equal(ours.depth(camera, step), within)
                difference = np.abs(ours.rgb(camera, step).astype(int) - theirs.rgb(camera, step))
                assert difference.mean() < 6  # the made-up pictures are all edges; subsampled colours bleed there
        shown = np.stack(list(ours.frames("base_camera", "depth")))
        assert shown.shape == (7, 48, 64)
        assert shown.dtype == np.uint16


def test_depth_of_all_16_bits(trajectory, tmp_path):
    noise = np.random.default_rng(0).integers(0, 65536, (7, 48, 64), np.uint16)

    class Noisy(RayCaster):
        def frames(self, recording, samples):
            for step, frame in enumerate(super().frames(recording, samples)):
                frame.depth["gripper_camera"][:] = noise[step]
                yield frame

    convert_lerobot(ConversionSettings(trajectory, tmp_path / "out", open_renderer=Noisy, lerobot_version="0.5"))
    found = LeRobotDataset(tmp_path / "out").episode(1)
    np.testing.assert_array_equal(np.stack(list(found.frames("gripper_camera", "depth"))), noise)


def test_each_video_frame_is_that_of_its_step(trajectory, tmp_path):
    """The grey level is the number of the frame: joining must neither drop, double nor shift one."""

    class Grey(RayCaster):
        def frames(self, recording, samples):
            for step, frame in enumerate(super().frames(recording, samples)):
                frame.rgb["base_camera"][:] = 20 * step + 10 * recording.seed
                yield frame

    out = tmp_path / "out"
    convert_lerobot(
        ConversionSettings(trajectory, out, open_renderer=Grey, include_failed=True, cameras=("base_camera",))
    )
    dataset = LeRobotDataset(out)
    for number, seed in enumerate((3, 4, 5)):
        for step in (6, 0, 5, 2):
            level = dataset.episode(number).rgb("base_camera", step).mean()
            assert abs(level - (20 * step + 10 * seed)) < 4


def test_statistics_are_those_of_the_data(lerobot):
    stats = json.loads((lerobot / "meta/stats.json").read_text())
    dataset = LeRobotDataset(lerobot)
    action = np.concatenate([dataset.episode(i).columns["action"] for i in (0, 1)])
    np.testing.assert_allclose(stats["action"]["mean"], action.mean(axis=0), atol=1e-6)
    np.testing.assert_allclose(stats["action"]["std"], action.std(axis=0), atol=1e-6)
    np.testing.assert_allclose(stats["action"]["max"], action.max(axis=0))
    assert stats["action"]["count"] == [14]
    assert stats["observation.images.base_camera"]["count"] == [14]
    frames = np.stack([frame for i in (0, 1) for frame in dataset.episode(i).frames("base_camera")])
    mean = np.array(stats["observation.images.base_camera"]["mean"]).reshape(3)
    np.testing.assert_allclose(mean, frames.mean(axis=(0, 1, 2)) / 255, atol=0.02)
    rows = pq.read_table(lerobot / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    first = dataset.episode(0).columns["action"]
    np.testing.assert_allclose(rows[0]["stats/action/mean"], first.mean(axis=0), atol=1e-6)
    assert rows[0]["stats/action/count"] == [7]


def test_files_roll_over_at_their_limits(trajectory, tmp_path, monkeypatch):
    out = tmp_path / "out"
    limits = "robocas_ms3.datasets.lerobot.convert.FILE_LIMITS"
    monkeypatch.setattr(limits, FileLimits(data_mb=1e-6, video_mb=100, video_seconds=14 / 5))
    convert(trajectory, out, include_failed=True)
    dataset = LeRobotDataset(out)
    assert [row["data/file_index"] for row in dataset.rows] == [0, 1, 2]
    assert [row["videos/observation.images.base_camera/file_index"] for row in dataset.rows] == [0, 0, 1]
    depth = "videos/observation.images.base_camera_depth"
    assert [row[f"{depth}/from_timestamp"] for row in dataset.rows] == [0, 1.4, 0]
    assert [row["meta/episodes/file_index"] for row in dataset.rows] == [0, 0, 0]
    assert check_lerobot(out).violations == []
    by_size = tmp_path / "by_size"
    monkeypatch.setattr(limits, FileLimits(video_mb=1e-6))
    convert(trajectory, by_size, include_failed=True)
    assert [row[f"{depth}/file_index"] for row in LeRobotDataset(by_size).rows] == [0, 1, 2]
    assert check_lerobot(by_size).violations == []


def test_fewer_pictures_and_another_rate(trajectory, tmp_path):
    out = tmp_path / "out"
    convert(trajectory, out, rate_hz=10, cameras=("static_camera",), size=(80, 60), depth=False)
    dataset = LeRobotDataset(out)
    assert (dataset.cameras, dataset.has_depth, dataset.rate_hz) == (("static_camera",), False, 10)
    assert sorted(path.name for path in (out / "videos").iterdir()) == ["observation.images.static_camera"]
    assert dataset.episode(0).rgb("static_camera", 5).shape == (60, 80, 3)
    assert dataset.episode(0).columns["timestamp"][3, 0] == pytest.approx(0.3)
    assert check_lerobot(out).violations == []


def fails(match, source, out, kind=RobocasError, **kwargs):
    with pytest.raises(kind, match=match) as caught:
        convert(source, out, **kwargs)
    assert "\n" not in str(caught.value)
    assert not Path(out).exists()


def test_errors_leave_nothing_behind(trajectory, made, tmp_path):
    out = tmp_path / "out"
    fails("whole number of frames a second", trajectory, out, rate_hz=2.5)
    fails("the rate must divide the control frequency", trajectory, out, rate_hz=3)
    fails("no such trajectory file", tmp_path / "none.h5", out)
    fails("no dataset here", tmp_path, out)
    fails("a dataset keeps its rate .expected 5 Hz, found 10.", made, out, rate_hz=10)
    fails("a dataset keeps the size of its images .expected 64 x 48", made, out, size=(32, 32))
    fails("videos need even sizes .expected .* found 65 x 48", trajectory, out, size=(65, 48))
    fails("no successful episodes", write_trajectory(tmp_path / "failed.h5", seeds=(1,), failed=(0,)), out)


def test_an_output_that_exists_is_left_alone(trajectory, tmp_path):
    out = tmp_path / "out"
    convert(trajectory, out)
    before = files_of(out)
    with pytest.raises(OutputExistsError) as error:
        convert(trajectory, out, codec="av1")
    assert error.value.found == 'settings.codec: "h264" -> "av1"'
    with pytest.raises(OutputExistsError, match='settings.lerobot_version: "0.6" -> "2.1"'):
        convert(trajectory, out, lerobot_version="2.1")
    with pytest.raises(OutputExistsError, match="other episodes"):
        convert(trajectory, out, include_failed=True)
    with pytest.raises(DatasetError):
        convert(tmp_path / "missing.h5", out, overwrite=True)
    assert files_of(out) == before
    done = convert(trajectory, out)
    assert (done.episodes, done.kept) == ([], 2)
    assert files_of(out) == before
    convert(trajectory, out, overwrite=True, include_failed=True)
    assert LeRobotDataset(out).info["total_episodes"] == 3


def test_failed_episodes_of_a_folder_stay_out(made, tmp_path):
    source = shutil.copytree(made, tmp_path / "source")
    scene = json.loads((source / "episode_0000000/scene.json").read_text())
    (source / "episode_0000000/scene.json").write_text(json.dumps({**scene, "success": False}))
    convert(source, tmp_path / "out")
    dataset = LeRobotDataset(tmp_path / "out")
    assert [entry["source"] for entry in dataset.settings["episodes"]] == [1]
    assert dataset.numbers == [0]
    assert check_lerobot(tmp_path / "out").violations == []


@pytest.mark.parametrize("source", [None, {"recording": None}])
def test_episodes_of_unknown_recordings_are_told_by_their_arrays(dataset, source):
    scene = dataset / "episode_0000001" / "scene.json"
    scene.write_text(json.dumps({**json.loads(scene.read_text()), "source": source}))
    ledger = dataset / "conversion.json"
    content = json.loads(ledger.read_text())
    content["episodes"]["1"]["recording"] = None
    ledger.write_text(json.dumps(content))
    entries = open_input(ConversionSettings(dataset, dataset.with_name("out"))).entries()
    expected = arrays_fingerprint(Dataset(dataset).episode(1).arrays)
    assert entries[1]["recording"] == f"arrays {expected}"


def test_from_the_command_line(made, tmp_path, capsys):
    command = ["convert", str(made), "--to", "lerobot", "--out", str(tmp_path / "out")]
    assert main.run([*command, "--append"]) == 1
    assert capsys.readouterr().err == "error: --append: not for LeRobot datasets. Leave it out.\n"
    assert main.run([*command, "--codec", "av1", "--cameras", "static_camera", "--no-depth"]) == 0
    assert "2 episodes, 14 steps" in capsys.readouterr().out
    assert LeRobotDataset(tmp_path / "out").cameras == ("static_camera",)
    assert main.run(command) == 1
    assert "written with other settings" in capsys.readouterr().err
