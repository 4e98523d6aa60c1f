"""One small dataset of each version, from conversion to check and back."""

import json
import shutil
from functools import partial

import numpy as np
import pytest
from lerobot_folders import DATA, convert, files_of

pytest.importorskip("av", reason="needs the extra 'lerobot'")
pq = pytest.importorskip("pyarrow.parquet", reason="needs the extra 'lerobot'")

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.poses import inverse
from robocas_ms3.datasets.formats import open_source
from robocas_ms3.datasets.images.image_files import compute_bounding_box
from robocas_ms3.datasets.lerobot import schema
from robocas_ms3.datasets.lerobot.check import check_lerobot
from robocas_ms3.datasets.lerobot.reader import LeRobotDataset
from robocas_ms3.datasets.lerobot.variants import VARIANTS
from robocas_ms3.datasets.sources.reader import Dataset
from robocas_ms3.demos.recordings.trajectory_file import TrajectoryFile


@pytest.fixture(params=VARIANTS)
def version(request):
    return request.param


def test_each_version_passes_the_check_and_restores_the_episodes(versions, version, made):
    assert check_lerobot(versions / version, decode=True).violations == []
    dataset, source = open_source(versions / version), Dataset(made)
    for ours, theirs in ((0, 0), (2, 1)):  # the source has no failed episode
        episode, wanted = dataset.episode(ours), source.episode(theirs)
        assert episode.goals == wanted.goals
        for key, values in episode.arrays.items():
            if key in ("rel_orn", "base_rel_orn", "base_rel_pos"):  # computed from absolute poses
                np.testing.assert_allclose(values, wanted.arrays[key], atol=1e-6, err_msg=key)
            else:
                np.testing.assert_array_equal(values, wanted.arrays[key], err_msg=key)
        for camera in episode.cameras:
            np.testing.assert_array_equal(episode.intrinsic(camera), wanted.intrinsic(camera))
            np.testing.assert_array_equal(episode.camera_in_parent(camera), wanted.camera_in_parent(camera))
            limit = schema.MAX_DEPTH_MM if VARIANTS[version].native_depth else 65535
            for step in (6, 0, 4):  # bit for bit, whatever the order
                depth = np.minimum(wanted.depth(camera, step), limit)
                np.testing.assert_array_equal(episode.depth(camera, step), depth)
                assert np.abs(episode.rgb(camera, step).astype(int) - wanted.rgb(camera, step)).mean() < 6
        assert np.stack(list(episode.frames("base_camera", "depth"))).shape == (7, 48, 64)


def test_conversion_is_deterministic(versions, version, trajectory, tmp_path):
    jobs = 2 if version == "0.6" else 1
    convert(trajectory, tmp_path / "out", include_failed=True, lerobot_version=version, jobs=jobs)
    assert files_of(tmp_path / "out") == files_of(versions / version)


def test_conversion_between_versions(versions, version, tmp_path):
    for other in VARIANTS:
        convert(versions / other, tmp_path / other, include_failed=True, lerobot_version=version)
        assert check_lerobot(tmp_path / other).violations == []
        ours, theirs = LeRobotDataset(tmp_path / other).episode(2), LeRobotDataset(versions / other).episode(2)
        assert ours.goals == theirs.goals
    again = LeRobotDataset(tmp_path / "0.6").episode(2)
    kept = LeRobotDataset(versions / "0.6").episode(2).target_boxes if version == "0.6" else []
    assert list(again.target_boxes) == list(kept)


def test_the_folder_of_version_0_6(versions):
    root = versions / "0.6"
    expected = {
        *(f"meta/{name}" for name in ("info.json", "stats.json", "tasks.parquet")),
        *(f"meta/robocas/{name}" for name in ("conversion.json", "episodes.parquet", "checksums.json")),
        "meta/episodes/chunk-000/file-000.parquet",
        DATA,
    }
    for camera in ("base", "gripper", "static"):
        expected.add(f"videos/observation.images.{camera}_camera/chunk-000/file-000.mp4")
        expected.add(f"videos/observation.images.{camera}_camera_depth/chunk-000/file-000.mp4")
    for number in range(3):
        expected |= {f".annotate_staging/episode_{number:06d}/{name}.jsonl" for name in ("plan", "vqa")}
    assert set(files_of(root)) == expected
    info = json.loads((root / "meta/info.json").read_text())
    assert (info["codebase_version"], info["splits"]) == ("v3.0", {"train": "0:3"})
    assert (info["fps"], info["total_episodes"], info["total_frames"], info["total_tasks"]) == (5, 3, 21, 3)
    video = info["features"]["observation.images.base_camera"]
    assert (video["dtype"], video["shape"], video["info"]["video.codec"]) == ("video", [48, 64, 3], "h264")
    # Every column but the videos, in the features' order, of their types: `datasets` casts by them.
    table = pq.read_table(root / DATA)
    assert table.column_names == [key for key, ft in info["features"].items() if ft["dtype"] != "video"]
    assert str(table.schema.field("action").type) == "fixed_size_list<element: float>[7]"
    assert table.column("index").to_pylist() == list(range(21))
    assert table.column("frame_index").to_pylist() == [*range(7)] * 3
    np.testing.assert_allclose(table.column("timestamp").to_pylist()[:7], np.arange(7) / 5, atol=1e-6)


def test_statistics_match_the_data(versions):
    root = versions / "0.6"
    stats, dataset = json.loads((root / "meta/stats.json").read_text()), LeRobotDataset(root)
    rows = pq.read_table(root / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    actions = [dataset.episode(number).columns["action"] for number in range(3)]
    for found, values in (
        (stats["action"], np.concatenate(actions)),
        ({key: rows[1][f"stats/action/{key}"] for key in stats["action"]}, actions[1]),
    ):
        quantiles = {f"q{share:02}": partial(np.quantile, q=share / 100) for share in (1, 10, 50, 90, 99)}
        functions = {"mean": np.mean, "std": np.std, "min": np.min, "max": np.max, **quantiles}
        for key, function in functions.items():
            np.testing.assert_allclose(found[key], function(values.astype(float), axis=0), atol=1e-6, err_msg=key)
        assert found["count"] == [len(values)]
    assert all(type(value) is int for value in stats["next.success"]["min"] + stats["index"]["max"])
    frames = np.stack([frame for n in range(3) for frame in dataset.episode(n).frames("base_camera")])
    mean = np.array(stats["observation.images.base_camera"]["mean"]).reshape(3)
    np.testing.assert_allclose(mean, frames.mean(axis=(0, 1, 2)) / 255, atol=0.02)


def test_language_and_outcome_of_version_0_6(versions):
    table = pq.read_table(versions / "0.6" / DATA)
    assert table.column("next.done").to_pylist() == ([False] * 6 + [True]) * 3
    success = [False] * 6 + [True] + [False] * 7 + [False] * 6 + [True]  # the second episode failed
    assert table.column("next.success").to_pylist() == success
    assert table.column("next.reward").to_pylist() == [float(value) for value in success]
    rows, events = (table.column(key).to_pylist() for key in ("language_persistent", "language_events"))
    assert all(frame == rows[14] for frame in rows[14:])
    starts = [(row["timestamp"], row["content"]) for row in rows[14] if row["style"] == "subtask"]
    assert starts == [(0.0, "grasp the cube 5 on the table"), (pytest.approx(0.6), "Drop the cube 5 into the basket")]
    questions = [row["content"] for row in events[14] if row["role"] == "user"]
    assert questions == ["Where is the cube 5?"] * (len(events[14]) // 2) != []
    plan, vqa = (
        [json.loads(line) for line in (versions / "0.6" / schema.STAGING / "episode_000002" / name).open()]
        for name in ("plan.jsonl", "vqa.jsonl")
    )
    assert plan == rows[14]
    times = table.column("timestamp").to_pylist()
    assert vqa == [{**row, "timestamp": times[frame]} for frame in range(14, 21) for row in events[frame]]


def test_boxes_contain_the_projected_target(versions, trajectory):
    """The centre of the target, projected into a camera that sees all of it, is in its box."""
    episode = LeRobotDataset(versions / "0.6").episode(0)
    with TrajectoryFile(trajectory) as file:
        centres = file.read_recording(0).states["actors"]["object_0"][[0, 4, 8, 12, 16, 20, 22], :3]
    world_in_camera = inverse(episode.camera_in_parent("static_camera"))
    fx, fy, cx, cy = episode.intrinsic("static_camera")
    for centre, boxes in zip(centres, episode.target_boxes, strict=True):
        x, y, z = world_in_camera[:3, :3] @ centre + world_in_camera[:3, 3]
        left, top, right, bottom = boxes["static_camera"]
        assert left <= fx * x / z + cx <= right + 1
        assert top <= fy * y / z + cy <= bottom + 1
        assert (right - left, bottom - top) < (20, 20)
    assert compute_bounding_box(np.array([[0, 0, 0], [0, 1, 0], [0, 1, 1]], bool)) == (1, 1, 2, 2)
    assert compute_bounding_box(np.zeros((2, 3), bool)) is None


def test_files_of_version_2_1(versions):
    root = versions / "2.1"
    info = json.loads((root / "meta/info.json").read_text())
    totals = [info[f"total_{name}"] for name in ("episodes", "videos", "chunks")]
    assert (info["codebase_version"], totals) == ("v2.1", [3, 9, 1])
    assert info["data_path"] == "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
    episodes, tasks, stats = (
        [json.loads(line) for line in (root / f"meta/{name}.jsonl").open()]
        for name in ("episodes", "tasks", "episodes_stats")
    )
    assert [(line["episode_index"], line["length"]) for line in episodes] == [(0, 7), (1, 7), (2, 7)]
    assert [line["tasks"] for line in episodes] == [[task["task"]] for task in tasks]
    assert [task["task_index"] for task in tasks] == [0, 1, 2]
    second = pq.read_table(root / "data/chunk-000/episode_000001.parquet")
    assert second.column("index").to_pylist() == list(range(7, 14))
    action = np.array(second.column("action").to_pylist())
    np.testing.assert_allclose(stats[1]["stats"]["action"]["mean"], action.mean(axis=0), atol=1e-6)
    assert np.shape(stats[1]["stats"]["observation.images.base_camera"]["mean"]) == (3, 1, 1)
    assert (root / "videos/chunk-000/observation.images.base_camera/episode_000002.mp4").is_file()
    assert (root / "depth/chunk-000/base_camera/episode_000002.mkv").is_file()
    modality = json.loads((root / "meta/modality.json").read_text())
    assert modality["state"]["robot_joints"] == {"start": 7, "end": 14}
    assert modality["state"]["agv_pose"]["end"] == info["features"]["observation.state"]["shape"][0]
    assert modality["action"]["gripper_open"] == {"start": 6, "end": 7}


@pytest.mark.parametrize(
    ("name", "text", "file"),
    [
        ("meta/episodes.jsonl", "{", "meta"),
        ("meta/episodes.jsonl", '{"episode_index": 0, "tasks": ["a"], "length": "7"}', "meta"),
        ("meta/episodes.jsonl", '{"episode_index": 0, "tasks": ["a"], "length": 1e300}', "meta"),
        ("meta/tasks.jsonl", '{"task_index": -1, "task": "a"}', "meta"),
        ("meta/episodes_stats.jsonl", '{"episode_index": 0, "stats": {}}', "meta/episodes_stats.jsonl"),
    ],
)
def test_damaged_lines_of_version_2_1(versions, tmp_path, name, text, file):
    spoiled = shutil.copytree(versions / "2.1", tmp_path / "spoiled")
    (spoiled / name).write_text(text + "\n")
    assert file in {violation.file for violation in check_lerobot(spoiled).violations}
    if file == "meta":
        with pytest.raises(DatasetError):
            _ = LeRobotDataset(spoiled).rows, LeRobotDataset(spoiled).tasks


def test_wrong_videos_of_version_2_1_are_reported(versions, tmp_path):
    spoiled = shutil.copytree(versions / "2.1", tmp_path / "spoiled")
    folder = "videos/chunk-000/observation.images.base_camera"
    shutil.copy(spoiled / folder / "episode_000000.mp4", spoiled / folder / "episode_000003.mp4")
    (spoiled / folder / "episode_000001.mp4").unlink()
    found = {violation.file: violation.expected for violation in check_lerobot(spoiled).violations}
    assert found[f"{folder}/episode_000003.mp4"] == "files of episodes only"
    assert f"{folder}/episode_000001.mp4" in found
