import shutil

import numpy as np
import pytest
from lerobot_folders import DATA, DEPTH, EPISODES, VIDEO, edit_json

pytest.importorskip("av", reason="needs the extra 'lerobot'")
pa = pytest.importorskip("pyarrow", reason="needs the extra 'lerobot'")
pq = pytest.importorskip("pyarrow.parquet", reason="needs the extra 'lerobot'")

from robocas_ms3.datasets.checks.dataset import ValidationReport
from robocas_ms3.datasets.lerobot import schema
from robocas_ms3.datasets.lerobot.check import check_lerobot
from robocas_ms3.datasets.lerobot.tables import to_array, to_column, write_texts
from robocas_ms3.datasets.lerobot.video import VIDEO_CODECS, VideoEncoder


def found(root, **options):
    """File and key of each violation."""
    return {(violation.file, violation.key) for violation in check_lerobot(root, **options).violations}


def change(root, key, edit, file=DATA):
    """Change a column of a table in place."""
    table = pq.read_table(root / file)
    values = table.column(key)
    if pa.types.is_string(values.type):
        changed = pa.array(edit(values.to_pylist()), values.type)
    else:
        array = to_array(values).copy()
        edit(array)
        changed = to_column(array).cast(values.type)
    pq.write_table(table.set_column(table.column_names.index(key), key, changed), root / file)


def test_a_valid_dataset(valid):
    seen = []
    assert check_lerobot(valid, on_episode=lambda done, all: seen.append((done, all))) == ValidationReport(2, 14, [])
    assert seen == [(1, 2), (2, 2)]


@pytest.mark.parametrize(
    ("key", "cell", "value", "where"),
    [
        ("index", (9, 0), 3, "episode 1, index"),
        ("frame_index", (2, 0), 3, "episode 0, frame_index"),
        ("timestamp", (3, 0), 0.61, "episode 0, timestamp 3"),
        ("task_index", (slice(0, 7), 0), 1, "episode 0, task_index"),
        ("subtask_index", (0, 0), -1, "episode 0, subtask_index"),
        ("action", (8, 2), np.nan, "episode 1, action"),
        ("action", (8, 6), 0.5, "episode 1, action"),
        ("action.joint", (8, 0), 3.0, "episode 1, action.joint"),
        ("observation.state", (1, 0), 50.0, "observation.state"),  # in the statistics
        ("observation.state", (1, 3), 3.0, "episode 0, ee_orn"),
        ("observation.state", (slice(1, 2), slice(3, 7)), 0.0, "episode 0, observation.state, observation.arm_base"),
        ("observation.state", (9, 14), 0.5, "episode 1, gripper_width"),
        ("action", (8, 0), 0.5, "episode 1, rel_pos"),
        ("action.base", (1, 0), 5.0, "episode 0, rel_agv_pose"),
    ],
)
def test_wrong_numbers_are_reported(spoiled, key, cell, value, where):
    change(spoiled, key, lambda array: array.__setitem__(cell, value))
    assert (schema.STATS_FILE if where == key else DATA, where) in found(spoiled)


def test_wrong_texts_are_reported(spoiled):
    change(spoiled, "subgoal_type", lambda texts: ["dance", *texts[1:]])
    assert (DATA, "episode 0, subgoal_type") in found(spoiled)
    write_texts(spoiled / schema.TASKS_FILE, "task_index", ["one", "one"])
    assert (schema.TASKS_FILE, "") in found(spoiled)


def test_scenes_of_all_episodes_are_checked(spoiled):
    change(spoiled, "cameras", lambda texts: ["{", "{"], schema.SCENES_FILE)
    edit_json(spoiled, schema.CONVERSION_FILE, lambda made: made.update(val_eps=[7]))
    wrong = {(schema.CONVERSION_FILE, ""), *((schema.SCENES_FILE, f"episode {number}") for number in (0, 1))}
    assert wrong <= found(spoiled)


def test_missing_rows_are_reported(spoiled):
    table = pq.read_table(spoiled / DATA)
    pq.write_table(table.slice(0, 12), spoiled / DATA)
    assert (DATA, "rows") in found(spoiled)
    pq.write_table(table.drop(["action"]), spoiled / DATA)
    assert (DATA, "columns") in found(spoiled)
    (spoiled / schema.CHECKSUMS_FILE).unlink()
    (spoiled / DATA).write_bytes((spoiled / DATA).read_bytes()[:-100])
    assert found(spoiled) == {(DATA, "")}
    (spoiled / DATA).unlink()
    assert found(spoiled) == {(DATA, "")}


def test_inconsistent_overviews_are_reported(spoiled):
    video = "videos/observation.images.base_camera"
    change(spoiled, "dataset_from_index", lambda array: array.__setitem__((1, 0), 8), EPISODES)
    change(spoiled, f"{video}/from_timestamp", lambda array: array.__setitem__((1, 0), 1.6), EPISODES)
    edit_json(spoiled, "meta/info.json", lambda info: info.update(total_frames=15))
    edit_json(spoiled, "meta/stats.json", lambda stats: stats["action"].pop("q50"))
    edit_json(spoiled, "meta/stats.json", lambda stats: stats["observation.images.base_camera"].update(mean=[1, 2, 3]))
    assert found(spoiled) >= {
        ("meta/episodes", "episode 1, dataset_from_index"),
        ("meta/episodes", f"episode 1, {video}"),
        ("meta/info.json", "total_frames"),
        ("meta/stats.json", "action"),
        ("meta/stats.json", "observation.images.base_camera, mean"),
    }


@pytest.mark.parametrize("name", [VIDEO, DEPTH])
def test_wrong_videos_are_reported(spoiled, name):
    (spoiled / schema.CHECKSUMS_FILE).unlink()
    path = spoiled / name
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    assert name in {file for file, _ in found(spoiled, decode=True)}
    path.unlink()
    assert (name, "") in found(spoiled)
    coding, image = VIDEO_CODECS["h264" if name == VIDEO else "depth"], np.zeros((48, 64), np.uint16)
    if name == VIDEO:
        image = np.zeros((48, 64, 3), np.uint8)
    for fps, frames, key in ((5, 13, "frames"), (4, 14, "time of frame 1")):
        with VideoEncoder(path, coding, fps, (64, 48)) as encoder:
            for _ in range(frames):
                encoder.add(image)
        assert (name, key) in found(spoiled)
    other = path.parent / "file-001.bin"
    other.write_bytes(whole)
    assert (str(other.relative_to(spoiled)), "") in found(spoiled)


@pytest.mark.parametrize("name", [DATA, VIDEO, DEPTH])
def test_flipped_bit_is_reported(spoiled, name):
    """Even where a decoder conceals it."""
    data = bytearray((spoiled / name).read_bytes())
    data[len(data) // 2] ^= 1
    (spoiled / name).write_bytes(data)
    assert (name, "") in found(spoiled)
    (spoiled / schema.CHECKSUMS_FILE).write_text("{")
    assert (schema.CHECKSUMS_FILE, "") in found(spoiled)


def test_dataset_without_robocas_files_is_valid(spoiled):
    """As LeRobot's tools write them: no checksums, no scenes, no depth."""
    shutil.rmtree(spoiled / "meta/robocas")
    shutil.rmtree(spoiled / "depth")
    table = pq.read_table(spoiled / EPISODES)
    pq.write_table(table.drop([name for name in table.column_names if name.startswith("depth")]), spoiled / EPISODES)
    assert found(spoiled, decode=True) == set()


def test_interrupted_conversion_is_not_a_dataset(valid, tmp_path):
    """`meta` appears last."""
    shutil.copytree(valid / "data", tmp_path / "data")
    assert found(tmp_path) == {("meta/info.json", "")}
