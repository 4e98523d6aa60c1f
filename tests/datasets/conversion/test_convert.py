import json
import os
import shutil

import cv2
import h5py
import numpy as np
import pytest
from managing import convert_made_up as run
from managing import files_of
from synthetic import STEPS, RayCaster, stub_embeddings, write_trajectory

from robocas_ms3.core.errors import DatasetError, OutputExistsError, RobocasError
from robocas_ms3.core.poses import from_xyzw
from robocas_ms3.datasets.checks.dataset import validate
from robocas_ms3.datasets.conversion.convert import convert
from robocas_ms3.datasets.conversion.settings import ConversionSettings
from robocas_ms3.datasets.images.image_files import ImageOptions
from robocas_ms3.datasets.sources.file_models import SCENE_KEYS, DataInfoRecord
from robocas_ms3.datasets.sources.reader import Dataset
from robocas_ms3.demos.recordings.trajectory_file import TrajectoryFile


def test_folder_matches_the_schema(made):
    names = {path.name for path in made.iterdir()}
    assert names == {"data_info.json", "conversion.json", "episode_0000000", "episode_0000001"}
    episode = made / "episode_0000001"
    assert {path.name for path in episode.iterdir()} == {
        "episode_info.npz", "scene.json", "base_camera", "gripper_camera", "static_camera",
    }  # fmt: skip
    for camera, parent in (("base", "arm_base"), ("gripper", "ee"), ("static", "world")):
        folder = episode / f"{camera}_camera"
        assert {path.name for path in folder.iterdir()} == {
            f"cam_pos_wrt_{parent}.npy", f"cam_pose_wrt_{parent}.npy", f"true_cam_pose_wrt_{parent}.npy",
            "intrinsic.npy", "rgb", "depth",
        }  # fmt: skip
        # 22 control steps with a stride of 4: states 0, 4, ..., 20 and 22.
        for kind in ("rgb", "depth"):
            assert sorted(path.name for path in (folder / kind).iterdir()) == [f"{i:04d}.png" for i in range(7)]
        np.testing.assert_array_equal(np.load(folder / "intrinsic.npy"), [24, 24, 32, 24])


def test_failed_episodes_are_omitted_and_numbers_have_no_gaps(made, trajectory, tmp_path):
    info = json.loads((made / "data_info.json").read_text())
    assert set(info) == set(DataInfoRecord.model_fields)
    assert sorted(info["train_eps"] + info["val_eps"]) == [0, 1]
    assert len(info["val_eps"]) == 1
    assert info["ep_length"] == {"0": 7, "1": 7}
    assert info["language_goal"]["1"] == "grasp the cube 5 on the table and move it to the basket"
    # Actions 0..11 and 12..21: states 0, 4, 8 and 12, 16, 20, 22.
    assert [goal["goal_range"] for goal in info["step_goals"]["0"]] == [[0, 2], [3, 6]]
    record = json.loads((made / "conversion.json").read_text())
    assert [(e["trajectory_episode"], e["seed"]) for e in record["episodes"].values()] == [(0, 3), (2, 5)]
    assert record["rate_hz"] == 5
    assert len(run(trajectory, tmp_path / "all", include_failed=True).episodes) == 3


def test_arrays_equal_the_sampled_states(made, trajectory):
    samples = [0, 4, 8, 12, 16, 20, 22]
    with TrajectoryFile(trajectory) as file:
        recording = file.read_recording(2)
    robot, motion = (
        recording.states["articulations"]["robocas_mobile_panda"][samples],
        recording.compute_motion(samples),
    )
    with np.load(made / "episode_0000001" / "episode_info.npz", allow_pickle=False) as arrays:
        np.testing.assert_array_equal(arrays["robot_joints"], robot[:, 16:23])
        base = from_xyzw(arrays["base_pos"], arrays["base_orn"])
        ee = base @ from_xyzw(arrays["ee_pos"], arrays["ee_orn"])
        # Actions 0..8 open; state 8 was reached by action 7, state 12 by action 11.
        assert arrays["gripper_status"].tolist() == [True, True, True, False, False, False, False]
    np.testing.assert_allclose(base, motion.arm_base_in_world, atol=1e-5)
    np.testing.assert_allclose(ee, motion.tcp_in_world, atol=1e-5)


def test_images_equal_the_rendered_ones(made, trajectory):
    source = RayCaster({}, "pd_joint_pos", None)
    with TrajectoryFile(trajectory) as file:
        frame = list(source.frames(file.read_recording(2), np.array([0, 4, 8, 12, 16, 20, 22])))[3]
    for camera in frame.rgb:
        folder = made / "episode_0000001" / camera
        rgb = cv2.cvtColor(cv2.imread(str(folder / "rgb" / "0003.png"), cv2.IMREAD_UNCHANGED), cv2.COLOR_BGR2RGB)
        np.testing.assert_array_equal(rgb, frame.rgb[camera])
        depth = cv2.imread(str(folder / "depth" / "0003.png"), cv2.IMREAD_UNCHANGED)
        assert depth.dtype == np.uint16
        np.testing.assert_array_equal(depth, frame.depth[camera])


def test_v0_loader_reads_the_dataset(made):
    """The accesses of the RoboCAS-v0 loader to paths and keys."""
    info = json.loads((made / "data_info.json").read_text())
    for index in info["train_eps"] + info["val_eps"]:
        episode = os.path.join(made, "episode_%07d" % index)  # noqa: UP031
        data = np.load(os.path.join(episode, "episode_info.npz"))
        length = info["ep_length"][str(index)]
        actions = data["gripper_status"].astype(float).reshape(-1, 1)[1:length]
        assert len(np.concatenate([actions, actions[-1:]])) == length == len(data["rel_pos"])
        assert data["language_embedding"][np.newaxis].repeat(6, axis=0).shape == (6, 384)
        for goal in info["step_goals"][str(index)]:
            start, end = goal["goal_range"]
            assert data["step_goal_embs"][start : end + 1].shape == (end + 1 - start, 384)
        for camera in ("static", "base", "gripper"):
            assert os.path.isfile("%s/%s_camera/rgb/%04d.png" % (episode, camera, length - 1))  # noqa: UP031


def test_without_embeddings_and_at_another_rate(trajectory, tmp_path):
    run(trajectory, tmp_path / "out", rate_hz=10)
    with np.load(tmp_path / "out" / "episode_0000000" / "episode_info.npz") as arrays:
        assert "language_embedding" not in arrays
        assert len(arrays["rel_pos"]) == STEPS // 2 + 1


def test_resume_keeps_existing_episodes(trajectory, tmp_path):
    out = tmp_path / "out"
    run(trajectory, out)
    before = files_of(out)
    (out / "data_info.json").unlink()
    shutil.rmtree(out / "episode_0000001")
    kept = (out / "episode_0000000" / "episode_info.npz").stat().st_mtime_ns
    done = run(trajectory, out)
    assert (done.existing, [e.number for e in done.episodes]) == (1, [1])
    assert files_of(out) == before
    assert (out / "episode_0000000" / "episode_info.npz").stat().st_mtime_ns == kept
    with pytest.raises(OutputExistsError) as error:
        run(trajectory, out, rate_hz=10)
    assert error.value.found == "rate_hz: 5.0 -> 10.0"
    with pytest.raises(DatasetError):
        run(tmp_path / "missing.h5", out, overwrite=True)
    assert files_of(out) == before
    run(trajectory, out, overwrite=True, rate_hz=10)
    assert len(list((out / "episode_0000000" / "base_camera" / "rgb").iterdir())) == STEPS // 2 + 1


def fails(match, trajectory, out, **kwargs):
    with pytest.raises(RobocasError, match=match) as caught:
        run(trajectory, out, **kwargs)
    assert "\n" not in str(caught.value)
    assert not [*out.parent.glob(f"*{out.name}*")]


def test_errors_leave_nothing_behind(trajectory, tmp_path):
    out = tmp_path / "out"
    fails("no such trajectory file", tmp_path / "missing.h5", out)
    fails("the rate is not a divisor of the control frequency", trajectory, out, rate_hz=3)
    fails("no dataset to append to.*without --append first", trajectory, out, append=True)
    failed = write_trajectory(tmp_path / "failed.h5", seeds=(1, 2), failed=(0, 1))
    fails("no successful episodes to convert .found 2 episodes.*--include-failed", failed, out)
    fails("no episodes to convert", write_trajectory(tmp_path / "empty.h5", seeds=()), out)
    cut = write_trajectory(tmp_path / "cut.h5")
    cut.write_bytes(cut.read_bytes()[:-5000])
    fails("truncated", cut, out)
    broken = write_trajectory(tmp_path / "broken.h5", seeds=(1,))
    with h5py.File(broken, "a") as file:
        del file["traj_0/env_states"]
    fails("damaged episode", broken, out)


def test_removed_output_folder_is_an_error(trajectory, tmp_path):
    out = tmp_path / "out"
    with pytest.raises(RobocasError) as error:
        run(trajectory, out, on_episode=lambda episode: shutil.rmtree(out))
    assert error.value.where == out


def test_missing_render_device_is_reported_before_writing(trajectory, tmp_path, monkeypatch):
    import sapien

    def no_device(*_):
        raise RuntimeError("failed to find a rendering device")

    monkeypatch.setattr(sapien.render, "RenderMaterial", no_device)
    with pytest.raises(DatasetError, match="no render device. Run scripts/setup.sh or install a Vulkan driver"):
        convert(ConversionSettings(trajectory, tmp_path / "out", embeddings=False, video=False))
    assert not (tmp_path / "out").exists()


def test_scene_json_describes_the_recording(made, trajectory):
    scene = json.loads((made / "episode_0000001" / "scene.json").read_text())
    assert list(scene) == list(SCENE_KEYS)
    assert scene["seed"] == 5
    assert scene["success"] is True
    assert scene["env_info"]["env_id"] == "robocas_ms3:RoboCASPick-v1"
    assert scene["source"]["trajectory"] == "F.h5"
    assert scene["source"]["episode_id"] == 2
    ledger = json.loads((made / "conversion.json").read_text())["episodes"]
    assert scene["source"]["recording"] == ledger["1"]["recording"] != ledger["0"]["recording"]


@pytest.mark.parametrize("image_format", ["jpg", "webp"])
def test_fewer_and_smaller_images(trajectory, tmp_path, image_format):
    out = tmp_path / "out"
    image_options = ImageOptions(("static_camera", "base_camera"), (80, 60), depth=False, image_format=image_format)
    run(trajectory, out, cameras=image_options.cameras, size=(80, 60), depth=False, image_format=image_format)
    episode = Dataset(out).episode(1)
    assert (episode.cameras, episode.has_depth, episode.image_format) == (
        ("base_camera", "static_camera"),
        False,
        image_format,
    )
    frame = next(RayCaster({}, "", image_options).frames(recording(trajectory, 2), np.array([8])))
    difference = episode.rgb("base_camera", 2).astype(int) - frame.rgb["base_camera"]
    assert episode.rgb("base_camera", 2).shape == (60, 80, 3)
    assert np.abs(difference).mean() < 4  # lossy, but the same image
    assert validate(out).violations == []


def recording(trajectory, index):
    with TrajectoryFile(trajectory) as file:
        return file.read_recording(index)


def test_append_keeps_numbers_and_split(trajectory, tmp_path):
    out = tmp_path / "out"
    run(trajectory, out)
    before, info = files_of(out), json.loads((out / "data_info.json").read_text())
    more = write_trajectory(tmp_path / "more.h5", seeds=tuple(range(10, 18)))
    done = run(more, out, append=True)
    assert [e.number for e in done.episodes] == list(range(2, 10))
    after, info_after = files_of(out), json.loads((out / "data_info.json").read_text())
    changed = {name for name in before if after[name] != before[name]}
    assert changed == {"data_info.json", "conversion.json"}
    for part in ("train_eps", "val_eps"):
        assert set(info[part]) <= set(info_after[part])
    assert sorted(info_after["train_eps"] + info_after["val_eps"]) == list(range(10))
    assert json.loads((out / "episode_0000004" / "scene.json").read_text())["source"]["trajectory"] == "more.h5"
    assert validate(out).violations == []
    again = run(more, out, append=True)
    assert (again.existing, again.episodes) == (8, [])
    assert files_of(out) == after


def test_append_takes_cameras_and_size_from_the_dataset(trajectory, tmp_path):
    out, more = tmp_path / "out", write_trajectory(tmp_path / "more.h5", seeds=(10,))
    run(trajectory, out, cameras=("static_camera", "base_camera"), size=(80, 60))
    assert [episode.number for episode in run(more, out, append=True).episodes] == [2]
    episode = Dataset(out).episode(2)
    assert episode.cameras == ("base_camera", "static_camera")
    assert episode.rgb("static_camera", 0).shape == (60, 80, 3)
    assert validate(out).violations == []
    for other in ({"size": (64, 48)}, {"cameras": ("static_camera",)}):
        with pytest.raises(OutputExistsError):
            run(more, out, append=True, **other)


def test_conversion_with_other_versions_is_not_continued(trajectory, tmp_path):
    out, more = tmp_path / "out", write_trajectory(tmp_path / "more.h5", seeds=(10,))
    run(trajectory, out)
    about = json.loads((out / "conversion.json").read_text())
    about["made_with"]["sapien"] = "2.2.2"
    (out / "conversion.json").write_text(json.dumps(about))
    before = files_of(out)
    for source, append in ((trajectory, False), (more, True)):
        with pytest.raises(OutputExistsError, match='made_with.sapien: "2.2.2" -> '):
            run(source, out, append=append)
        assert files_of(out) == before
    about["made_with"] = {"robocas_ms3": "0.1.0"}  # older ones said no more
    (out / "conversion.json").write_text(json.dumps(about))
    assert run(trajectory, out).existing == 2
    assert len(run(more, out, append=True).episodes) == 1


def test_concurrent_append_is_refused(trajectory, tmp_path, monkeypatch):
    """A second conversion that starts after the first one assigned its numbers."""
    out = tmp_path / "out"
    more = write_trajectory(tmp_path / "more.h5", seeds=(10,))
    other = write_trajectory(tmp_path / "other.h5", seeds=(11,))
    monkeypatch.setattr("robocas_ms3.datasets.conversion.convert.embed_texts", stub_embeddings)
    run(trajectory, out, embeddings=True)

    def convert_another(file, chosen):
        with pytest.raises(RobocasError, match="another process writes to this folder"):
            run(other, out, append=True, embeddings=True)
        return stub_embeddings(file, chosen)

    monkeypatch.setattr("robocas_ms3.datasets.conversion.convert.embed_texts", convert_another)
    run(more, out, append=True, embeddings=True)
    monkeypatch.setattr("robocas_ms3.datasets.conversion.convert.embed_texts", stub_embeddings)
    run(other, out, append=True, embeddings=True)
    ledger = json.loads((out / "conversion.json").read_text())["episodes"]
    assert [entry["seed"] for entry in ledger.values()] == [3, 5, 10, 11]


def test_duplicate_recording_is_converted_once(tmp_path, caplog):
    trajectory = write_trajectory(tmp_path / "trajectory.h5", seeds=(3, 4, 3))
    done = run(trajectory, tmp_path / "out")
    assert [episode.number for episode in done.episodes] == [0, 1]
    assert "skipped duplicate recordings: episodes 2" in caplog.text
    assert validate(tmp_path / "out").violations == []
