import shutil

import numpy as np
import pytest
from lerobot_folders import DATA, DEPTH, EPISODES, VIDEO, edit_json

pytest.importorskip("av", reason="needs the extra 'lerobot'")
pa = pytest.importorskip("pyarrow", reason="needs the extra 'lerobot'")
pq = pytest.importorskip("pyarrow.parquet", reason="needs the extra 'lerobot'")

from robocas_ms3.datasets.checks.dataset import Report
from robocas_ms3.datasets.lerobot import schema
from robocas_ms3.datasets.lerobot.check import check_lerobot
from robocas_ms3.datasets.lerobot.tables import as_column, numbers, write_texts
from robocas_ms3.datasets.lerobot.video import CODINGS, Encoder


def found(root, **options):
    return [str(violation) for violation in check_lerobot(root, **options).violations]


def change(root, key, edit, file=DATA):
    """Change a column of a table in place."""
    table = pq.read_table(root / file)
    place = table.column_names.index(key)
    values = table.column(key)
    if pa.types.is_string(values.type) or pa.types.is_list(values.type):
        changed = pa.array(edit(values.to_pylist()), values.type)
    else:
        array = numbers(values).copy()
        edit(array)
        changed = as_column(array).cast(values.type)
    pq.write_table(table.set_column(place, key, changed), root / file)


def test_a_valid_dataset(valid):
    seen = []
    assert check_lerobot(valid, on_episode=lambda done, all: seen.append((done, all))) == Report(2, 14, [])
    assert seen == [(1, 2), (2, 2)]
    assert check_lerobot(valid, decode=True).violations == []


@pytest.mark.parametrize(
    ("key", "cell", "value", "message"),
    [
        ("index", (9, 0), 3, "episode 1, index: expected 7 to 13"),
        ("frame_index", (2, 0), 3, "episode 0, frame_index: expected 0 to 6"),
        ("timestamp", (3, 0), 0.61, "episode 0, timestamp 3: expected 0.6 s, found 0.61"),
        ("task_index", (slice(0, 7), 0), 1, "episode 0, task_index: expected the tasks of meta/episodes"),
        ("subtask_index", (0, 0), -1, "episode 0, subtask_index: expected 0 to 3"),
        ("action", (8, 2), np.nan, "episode 1, action: expected finite numbers"),
        ("action", (8, 6), 0.5, "episode 1, action: expected the gripper's command of the next step"),
        ("action.joint", (8, 0), 3.0, "episode 1, action.joint: expected the next step's joints"),
        ("observation.state", (1, 0), 50.0, "meta/stats.json, observation.state: expected min"),
        ("observation.state", (1, 3), 3.0, "episode 0, ee_orn: expected unit quaternions, found off by"),
        ("observation.state", (slice(1, 2), slice(3, 7)), 0.0, "episode 0, observation.state, observation.arm_base:"),
        ("observation.state", (9, 14), 0.5, "episode 1, gripper_width: expected -0.005 to 0.085 m"),
        ("action", (8, 0), 0.5, "episode 1, rel_pos: expected the motion between rows of ee_pos, ee_orn, found 1 of 7"),
        ("action.base", (1, 0), 5.0, "episode 0, rel_agv_pose: expected differences of agv_pose"),
    ],
)
def test_numbers_that_are_wrong(spoiled, key, cell, value, message):
    change(spoiled, key, lambda array: array.__setitem__(cell, value))
    assert any(message in text for text in found(spoiled)), found(spoiled)


def test_texts_that_are_wrong(spoiled):
    change(spoiled, "subgoal_type", lambda texts: ["dance", *texts[1:]])
    assert any("episode 0, subgoal_type: expected one of" in text for text in found(spoiled))
    write_texts(spoiled / schema.TASKS_FILE, "task_index", ["one", "one"])
    assert any("meta/tasks.parquet: expected each text once" in text for text in found(spoiled))


def test_rows_that_are_missing(spoiled):
    table = pq.read_table(spoiled / DATA)
    pq.write_table(table.slice(0, 12), spoiled / DATA)
    assert any(f"{DATA}, rows: expected 14, found 12" in text for text in found(spoiled))
    pq.write_table(table.drop(["action"]), spoiled / DATA)
    assert any(f"{DATA}, columns: expected" in text for text in found(spoiled))
    (spoiled / DATA).write_bytes((spoiled / DATA).read_bytes()[:-100])
    assert any(f"{DATA}: expected a readable table" in text for text in found(spoiled))
    (spoiled / DATA).unlink()
    assert any(f"{DATA}: expected a readable table" in text for text in found(spoiled))


def test_episodes_that_do_not_follow_each_other(spoiled):
    change(spoiled, "dataset_from_index", lambda array: array.__setitem__((1, 0), 8), EPISODES)
    change(
        spoiled, "videos/observation.images.base_camera/from_timestamp", lambda a: a.__setitem__((1, 0), 1.6), EPISODES
    )
    texts = found(spoiled)
    assert any("episode 1, dataset_from_index: expected 7, found 8" in text for text in texts)
    assert any("episode 1, videos/observation.images.base_camera: expected 1.4 to 2.8 s" in text for text in texts)


def test_overview_that_contradicts(spoiled):
    edit_json(spoiled, "meta/info.json", lambda info: info.update(total_frames=15))
    edit_json(spoiled, "meta/stats.json", lambda stats: stats["action"].pop("q50"))
    edit_json(spoiled, "meta/stats.json", lambda stats: stats["observation.images.base_camera"].update(mean=[1, 2, 3]))
    texts = found(spoiled)
    assert any("meta/info.json, total_frames: expected 14, found 15" in text for text in texts)
    assert any("meta/stats.json, action: expected numbers" in text and "q50" in text for text in texts)
    assert any("observation.images.base_camera, mean: expected shape (3, 1, 1)" in text for text in texts)


@pytest.mark.parametrize("name", [VIDEO, DEPTH])
def test_videos_that_are_wrong(spoiled, name):
    path = spoiled / name
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    assert any(name in text for text in found(spoiled, decode=True))
    path.unlink()
    assert any(f"{name}: expected a readable video" in text for text in found(spoiled))
    coding, picture = CODINGS["h264" if name == VIDEO else "depth"], np.zeros((48, 64), np.uint16)
    if name == VIDEO:
        picture = np.zeros((48, 64, 3), np.uint8)
    for fps, frames, message in (
        (5, 13, f"{name}, frames: expected 14, found 13"),
        (4, 14, f"{name}, time of frame 1"),
    ):
        with Encoder(path, coding, fps, (64, 48)) as encoder:
            for _ in range(frames):
                encoder.add(picture)
        assert any(message in text for text in found(spoiled)), message
    (path.parent / "file-001.bin").write_bytes(whole)
    assert any("file-001.bin: expected files of episodes only" in text for text in found(spoiled))


@pytest.mark.parametrize("name", [DATA, VIDEO, DEPTH])
def test_a_flipped_bit_shows(spoiled, name):
    """Even where a decoder conceals it."""
    path = spoiled / name
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    assert any(f"{name}: expected the bytes that were written" in text for text in found(spoiled))
    (spoiled / schema.CHECKSUMS_FILE).write_text("{")
    assert any("checksums.json: expected JSON" in text for text in found(spoiled))


def test_datasets_without_our_own_files(spoiled):
    """As LeRobot's tools write them: no checksums, no scenes, no depth."""
    shutil.rmtree(spoiled / "meta/robocas")
    shutil.rmtree(spoiled / "depth")
    table = pq.read_table(spoiled / EPISODES)
    pq.write_table(table.drop([name for name in table.column_names if name.startswith("depth")]), spoiled / EPISODES)
    assert found(spoiled, decode=True) == []


def test_a_conversion_that_was_interrupted(valid, tmp_path):
    """There is no `meta` before everything is there."""
    shutil.copytree(valid / "data", tmp_path / "data")
    assert "meta/info.json: expected JSON, found" in found(tmp_path)[0]
