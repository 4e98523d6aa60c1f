"""One small dataset of each version, from conversion to check and back."""

import json
import shutil
from typing import get_args

import numpy as np
import pytest
from lerobot_folders import files_of
from synthetic import RayCaster

pytest.importorskip("av", reason="needs the extra 'lerobot'")
pq = pytest.importorskip("pyarrow.parquet", reason="needs the extra 'lerobot'")

from robocas_ms3.cli import main
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.poses import inverse
from robocas_ms3.datasets.formats import open_source
from robocas_ms3.datasets.lerobot import schema
from robocas_ms3.datasets.lerobot.check import check_lerobot
from robocas_ms3.datasets.lerobot.convert import convert_lerobot
from robocas_ms3.datasets.lerobot.reader import LeRobotDataset
from robocas_ms3.datasets.lerobot.variants import NEWEST, VARIANTS, Version
from robocas_ms3.datasets.pictures.stored import box_of
from robocas_ms3.datasets.sources.reader import Dataset
from robocas_ms3.datasets.writing.settings import ConversionSettings
from robocas_ms3.demos.recordings.reading import TrajectoryFile
from robocas_ms3.viewer.source import open_source as open_page


@pytest.fixture(scope="module")
def datasets(trajectory, tmp_path_factory):
    """A dataset of three episodes of each version, of which the second failed."""
    root = tmp_path_factory.mktemp("versions")
    for version in VARIANTS:
        convert_lerobot(
            ConversionSettings(
                trajectory, root / version, open_renderer=RayCaster, include_failed=True, lerobot_version=version
            )
        )
    return root


@pytest.fixture(params=VARIANTS)
def version(request):
    return request.param


def test_the_versions_of_the_command_line_are_those_of_the_table():
    assert get_args(Version) == tuple(VARIANTS)
    assert NEWEST in VARIANTS


def test_each_version_passes_the_check_and_restores_the_episodes(datasets, version, made, tmp_path):
    root = datasets / version
    assert check_lerobot(root, decode=True).violations == []
    dataset, source = open_source(root), Dataset(made)
    for ours, theirs in ((0, 0), (2, 1)):  # the source has no failed episode
        episode, wanted = dataset.episode(ours), source.episode(theirs)
        assert episode.goals == wanted.goals
        for key in ("ee_pos", "ee_orn", "robot_joints", "agv_pose", "step_lang_goals", "step_goal_type"):
            np.testing.assert_array_equal(episode.arrays[key], wanted.arrays[key], err_msg=key)
        for camera in episode.cameras:
            limit = schema.MAX_DEPTH_MM if VARIANTS[version].native_depth else 65535
            np.testing.assert_array_equal(episode.depth(camera, 4), np.minimum(wanted.depth(camera, 4), limit))
            assert np.abs(episode.rgb(camera, 4).astype(int) - wanted.rgb(camera, 4)).mean() < 6
    assert open_page(root).episode(1)["steps"] == 7


def test_the_same_input_gives_the_same_bytes(datasets, version, trajectory, tmp_path):
    out = tmp_path / "out"
    convert_lerobot(
        ConversionSettings(
            trajectory, out, open_renderer=RayCaster, include_failed=True, lerobot_version=version, jobs=2
        )
    )
    assert files_of(out) == files_of(datasets / version)


def test_each_version_from_a_folder_and_from_another_version(datasets, version, made, tmp_path):
    convert_lerobot(ConversionSettings(made, tmp_path / "folder", lerobot_version=version))
    assert check_lerobot(tmp_path / "folder").violations == []
    for other in VARIANTS:
        convert_lerobot(
            ConversionSettings(datasets / other, tmp_path / other, include_failed=True, lerobot_version=version)
        )
        assert check_lerobot(tmp_path / other).violations == []
        ours, theirs = LeRobotDataset(tmp_path / other).episode(2), LeRobotDataset(datasets / other).episode(2)
        assert ours.goals == theirs.goals
    again = LeRobotDataset(tmp_path / "0.6").episode(2)
    kept = LeRobotDataset(datasets / "0.6").episode(2).target_boxes if version == "0.6" else []
    assert list(again.target_boxes) == list(kept)


def test_language_and_outcome_of_version_0_6(datasets, trajectory):
    table = pq.read_table(datasets / "0.6" / "data/chunk-000/file-000.parquet")
    assert table.column("next.done").to_pylist() == ([False] * 6 + [True]) * 3
    success = [False] * 6 + [True] + [False] * 7 + [False] * 6 + [True]  # the second episode failed
    assert table.column("next.success").to_pylist() == success
    assert table.column("next.reward").to_pylist() == [float(value) for value in success]
    rows = table.column("language_persistent").to_pylist()
    assert all(frame == rows[14] for frame in rows[14:])
    starts = [(row["timestamp"], row["content"]) for row in rows[14] if row["style"] == "subtask"]
    assert starts == [(0.0, "grasp the cube 5 on the table"), (pytest.approx(0.6), "Drop the cube 5 into the basket")]
    first = table.column("language_events").to_pylist()[14]
    assert [row["content"] for row in first if row["role"] == "user"] == ["Where is the cube 5?"] * (len(first) // 2)
    assert first


def test_boxes_hold_the_projected_target(datasets, trajectory):
    """The centre of the target, projected into a camera that sees all of it, is in its box."""
    episode = LeRobotDataset(datasets / "0.6").episode(0)
    with TrajectoryFile(trajectory) as file:
        centres = file.recording(0).states["actors"]["object_0"][[0, 4, 8, 12, 16, 20, 22], :3]
    world_in_camera = inverse(episode.camera_in_parent("static_camera"))
    fx, fy, cx, cy = episode.intrinsic("static_camera")
    assert len(episode.target_boxes) == len(centres)
    for centre, boxes in zip(centres, episode.target_boxes, strict=True):
        x, y, z = world_in_camera[:3, :3] @ centre + world_in_camera[:3, 3]
        left, top, right, bottom = boxes["static_camera"]
        assert left <= fx * x / z + cx <= right + 1
        assert top <= fy * y / z + cy <= bottom + 1
        assert (right - left, bottom - top) < (20, 20)


def test_the_box_of_a_mask():
    assert box_of(np.array([[0, 0, 0], [0, 1, 0], [0, 1, 1]], bool)) == (1, 1, 2, 2)
    assert box_of(np.zeros((2, 3), bool)) is None


def test_staged_rows_are_those_of_the_columns(datasets):
    root = datasets / "0.6"
    table = pq.read_table(root / "data/chunk-000/file-000.parquet").slice(7, 7)
    folder = root / schema.STAGING / "episode_000001"
    plan, vqa = (
        [json.loads(line) for line in (folder / f"{n}.jsonl").read_text().splitlines()] for n in ("plan", "vqa")
    )
    assert plan == table.column("language_persistent").to_pylist()[0]
    events, times = (table.column(key).to_pylist() for key in ("language_events", "timestamp"))
    assert vqa == [{**row, "timestamp": time} for rows, time in zip(events, times, strict=True) for row in rows]


def test_files_of_version_2_1(datasets):
    root = datasets / "2.1"
    info = json.loads((root / "meta/info.json").read_text())
    assert (info["codebase_version"], info["total_episodes"], info["total_videos"], info["total_chunks"]) == (
        "v2.1",
        3,
        9,
        1,
    )
    assert info["data_path"] == "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
    lines = [json.loads(line) for line in (root / "meta/episodes.jsonl").read_text().splitlines()]
    tasks = [json.loads(line) for line in (root / "meta/tasks.jsonl").read_text().splitlines()]
    assert [(line["episode_index"], line["length"]) for line in lines] == [(0, 7), (1, 7), (2, 7)]
    assert [line["tasks"] for line in lines] == [[task["task"]] for task in tasks]
    assert [task["task_index"] for task in tasks] == [0, 1, 2]
    stats = [json.loads(line) for line in (root / "meta/episodes_stats.jsonl").read_text().splitlines()]
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


@pytest.fixture
def spoiled(datasets, tmp_path):
    return shutil.copytree(datasets / "2.1", tmp_path / "spoiled")


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
def test_damaged_lines(spoiled, name, text, file):
    (spoiled / name).write_text(text + "\n")
    assert file in {violation.file for violation in check_lerobot(spoiled).violations}
    if file == "meta":
        with pytest.raises(DatasetError):
            _ = LeRobotDataset(spoiled).rows, LeRobotDataset(spoiled).tasks


def test_videos_of_version_2_1_that_are_wrong(spoiled):
    folder = spoiled / "videos/chunk-000/observation.images.base_camera"
    shutil.copy(folder / "episode_000000.mp4", folder / "episode_000003.mp4")
    (folder / "episode_000001.mp4").unlink()
    found = {violation.file: violation.expected for violation in check_lerobot(spoiled).violations}
    assert found[str((folder / "episode_000003.mp4").relative_to(spoiled))] == "files of episodes only"
    assert (folder / "episode_000001.mp4").relative_to(spoiled).as_posix() in found


def test_an_unknown_version_lists_the_choices(trajectory, tmp_path, capsys):
    with pytest.raises(DatasetError, match="unknown LeRobot version .expected 0.6, 0.5, 2.1, found 0.7"):
        convert_lerobot(ConversionSettings(trajectory, tmp_path / "out", lerobot_version="0.7"))
    assert not (tmp_path / "out").exists()
    command = ["convert", str(trajectory), "--out", str(tmp_path / "out"), "--lerobot-version", "2.1"]
    assert main.run(command) == 1
    assert capsys.readouterr().err == "error: --lerobot-version: not for RoboCAS folders. Leave it out.\n"
