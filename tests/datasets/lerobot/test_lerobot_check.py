import json
import shutil
from contextlib import suppress

import numpy as np
import pytest
from irregular import KINDS, replace_file
from synthetic import RayCaster

pytest.importorskip("av", reason="needs the extra 'lerobot'")
pa = pytest.importorskip("pyarrow", reason="needs the extra 'lerobot'")
pq = pytest.importorskip("pyarrow.parquet", reason="needs the extra 'lerobot'")

from robocas_ms3.datasets.lerobot import schema
from robocas_ms3.datasets.lerobot.check import check_lerobot, is_lerobot
from robocas_ms3.datasets.lerobot.convert import convert_lerobot
from robocas_ms3.datasets.lerobot.reader import LeRobotDataset
from robocas_ms3.datasets.lerobot.table_writing import column, write_texts
from robocas_ms3.datasets.lerobot.tables import TEXT, Column, numbers, read_objects, read_rows
from robocas_ms3.datasets.lerobot.video import CODINGS, Encoder
from robocas_ms3.datasets.pictures.stored import Pictures
from robocas_ms3.errors import DatasetError

DATA = "data/chunk-000/file-000.parquet"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"
VIDEO = "videos/observation.images.base_camera/chunk-000/file-000.mp4"
DEPTH = "depth/base_camera/chunk-000/file-000.mkv"


@pytest.fixture(scope="module")
def valid(trajectory, tmp_path_factory):
    out = tmp_path_factory.mktemp("checked") / "dataset"
    convert_lerobot(trajectory, out, pictures=Pictures(("base_camera",)), open_source=RayCaster, lerobot_version="0.5")
    return out


@pytest.fixture
def spoiled(valid, tmp_path):
    """A copy to spoil."""
    return shutil.copytree(valid, tmp_path / "spoiled")


def found(root, **options):
    return [str(violation) for violation in check_lerobot(root, **options)]


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
        changed = column(array).cast(values.type)
    pq.write_table(table.set_column(place, key, changed), root / file)


def edit_json(root, name, edit):
    content = json.loads((root / name).read_text())
    edit(content)
    (root / name).write_text(json.dumps(content))


def test_a_valid_dataset(valid, made):
    seen = []
    assert check_lerobot(valid, on_episode=lambda done, all: seen.append((done, all))) == []
    assert seen == [(1, 2), (2, 2)]
    assert check_lerobot(valid, decode=True) == []
    assert is_lerobot(valid)
    assert not is_lerobot(made)


@pytest.mark.parametrize(
    ("key", "cell", "value", "message"),
    [
        ("index", (9, 0), 3, "episode 1, index: expected 7 to 13"),
        ("frame_index", (2, 0), 3, "episode 0, frame_index: expected 0 to 6"),
        ("timestamp", (3, 0), 0.61, "episode 0, timestamp 3: expected 0.6 s, found 0.61"),
        ("task_index", (0, 0), 7, "episode 0, task_index: expected 0 to 1"),
        ("task_index", (slice(0, 7), 0), 1, "meta/episodes, episode 0, tasks: expected"),
        ("subtask_index", (0, 0), -1, "episode 0, subtask_index: expected 0 to 3"),
        ("action", (8, 2), np.nan, "episode 1, action: expected finite numbers"),
        ("action", (8, 6), 0.5, "episode 1, action: expected the gripper's command of the next step"),
        ("action.joint", (8, 0), 3.0, "episode 1, action.joint: expected the next step's joints"),
        ("observation.state", (1, 0), 50.0, "meta/stats.json, observation.state: expected min"),
        ("observation.state", (1, 3), 3.0, "episode 0, ee_orn: expected unit quaternions, found off by"),
        ("observation.state", (slice(1, 2), slice(3, 7)), 0.0, "episode 0, observation.state, observation.arm_base:"),
        ("observation.state", (9, 14), 0.5, "episode 1, gripper_width: expected 0 to 0.08 m"),
        ("action", (8, 0), 0.5, "episode 1, rel_pos: expected the motion between rows of ee_pos, ee_orn, found 1 of 7"),
        ("action", (8, 4), 0.3, "episode 1, rel_orn: expected the motion between rows of ee_pos, ee_orn, found 1 of 7"),
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
    assert any("meta/stats.json, action: expected q50, found nothing" in text for text in texts)
    assert any("observation.images.base_camera, mean: expected shape (3, 1, 1)" in text for text in texts)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("codebase_version", "v2.0"),
        *(("fps", value) for value in (5.5, 0, -1, 10**6, True, "5", None)),
        *(("total_frames", value) for value in (-1, 2**62, "14", 1e308)),
        ("data_path", "../{chunk_index}/{file_index:9999999999d}"),
        ("video_path", "{video_key.__class__}"),
        ("video_path", None),
        ("features", 3),
        ("features.action", {"dtype": "float32"}),
        ("features.action.shape", [0]),
        ("features.action.shape", [2**40]),
        ("features.action.shape", [6]),
        ("features.action.dtype", "object"),
        ("features.frame_index", None),
    ],
)
def test_wrong_values_of_the_overview(spoiled, key, value):
    def edit(info):
        *way, last = key.split(".", 2)
        for name in way:
            info = info[name]
        info[last] = value

    edit_json(spoiled, "meta/info.json", edit)
    violations = check_lerobot(spoiled)
    assert {violation.file for violation in violations} == {"meta/info.json"}
    assert any(key in violation.key + violation.expected for violation in violations)
    if key != "features.action.shape" or value != [6]:
        with pytest.raises(DatasetError):
            LeRobotDataset(spoiled)


def test_an_overview_that_is_not_json(spoiled):
    (spoiled / "meta/info.json").write_text("{")
    assert [violation.file for violation in check_lerobot(spoiled)] == ["meta/info.json"]


def table_of(root, file, key, make):
    """Write a table with another column in place of one."""
    table = pq.read_table(root / file)
    column = pa.array(make(table.column(key).to_pylist()))
    pq.write_table(table.set_column(table.column_names.index(key), key, column), root / file)


WRONG = {
    "strings": lambda rows: ["../.."] * len(rows),
    "nulls": lambda rows: [*rows[:-1], None],
    "negative": lambda rows: [-1] * len(rows),
    "huge": lambda rows: [2**62] * len(rows),
    "NaN": lambda rows: [float("nan")] * len(rows),
    "structures": lambda rows: [{"a": 1}] * len(rows),
    "ragged lists": lambda rows: [[1.0] * place for place in range(len(rows))],
}


@pytest.mark.parametrize(
    ("file", "key", "wrong"),
    [
        (EPISODES, "episode_index", "nulls"),
        (EPISODES, "length", "negative"),
        (EPISODES, "data/chunk_index", "strings"),
        (EPISODES, "tasks", "structures"),
        (EPISODES, "videos/observation.images.base_camera/file_index", "huge"),
        (EPISODES, "videos/observation.images.base_camera/from_timestamp", "NaN"),
        (DATA, "episode_index", "strings"),
        (DATA, "timestamp", "NaN"),
        (DATA, "subtask_index", "huge"),
        (DATA, "subgoal_type", "nulls"),
        (DATA, "action", "ragged lists"),
        (schema.TASKS_FILE, "task_index", "negative"),
        (schema.SUBTASKS_FILE, "subtask_index", "ragged lists"),
        (schema.SCENES_FILE, "episode_index", "nulls"),
        (schema.SCENES_FILE, "cameras", "structures"),
    ],
)
def test_columns_of_wrong_values(spoiled, file, key, wrong):
    table_of(spoiled, file, key, WRONG[wrong])
    assert [violation for violation in check_lerobot(spoiled) if "SHA-256" not in violation.expected]
    unused = key == "timestamp"
    with suppress(DatasetError) if unused else pytest.raises(DatasetError):
        read_all(spoiled)


@pytest.mark.parametrize("dtype", ["int64", "uint8", "bool", "string"])
def test_stored_types_other_than_declared(spoiled, dtype):
    edit_json(spoiled, schema.INFO_FILE, lambda info: info["features"]["action"].update(dtype=dtype))
    assert (DATA, "action") in {(violation.file, violation.key) for violation in check_lerobot(spoiled)}
    with pytest.raises(DatasetError):
        read_all(spoiled)


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        *((VIDEO, kind) for kind in KINDS),
        (DEPTH, "pipe"),
        (DATA, "pipe"),
        (EPISODES, "huge"),
        (schema.TASKS_FILE, "device"),
        (schema.STATS_FILE, "pipe"),
    ],
)
def test_irregular_files(spoiled, name, kind):
    (spoiled / schema.CHECKSUMS_FILE).unlink()
    replace_file(spoiled / name, kind)
    expected = "meta" if name in (EPISODES, schema.TASKS_FILE) else name
    assert [violation.file for violation in check_lerobot(spoiled)] == [expected]
    if name != schema.STATS_FILE:
        with pytest.raises(DatasetError):
            read_all(spoiled)


@pytest.mark.parametrize("count", [0, 10**6])
def test_totals_that_the_tables_contradict(spoiled, count):
    totals = "total_episodes", "total_frames", "total_tasks"
    edit_json(spoiled, schema.INFO_FILE, lambda info: info.update(dict.fromkeys(totals, count)))
    found = [(violation.file, violation.key) for violation in check_lerobot(spoiled)]
    assert found == [(schema.INFO_FILE, key) for key in ("total_episodes", "total_tasks", "total_frames")]


def read_all(root):
    dataset = LeRobotDataset(root)
    assert dataset.goals
    assert dataset.tasks
    for number in dataset.numbers:
        episode = dataset.episode(number)
        assert episode.arrays
        assert episode.scene
        episode.intrinsic("base_camera")
        episode.rgb("base_camera", 0)
        episode.depth("base_camera", 0)


@pytest.mark.parametrize("file", [DATA, EPISODES, schema.TASKS_FILE, schema.SCENES_FILE])
def test_rows_are_counted_before_they_are_read(spoiled, file, monkeypatch):
    """A file of 0.8 MB has 40 million rows of one value."""
    table = pq.read_table(spoiled / file).slice(0, 1)
    many = 20_000
    repeated = pa.table({name: pa.array(table.column(name).to_pylist() * many) for name in table.column_names[:2]})
    pq.write_table(repeated, spoiled / file, row_group_size=many)

    def refused(*_, **__):
        raise AssertionError("the rows are read")

    monkeypatch.setattr(pq.ParquetFile, "read_row_groups", refused)
    monkeypatch.setattr(pq, "read_table", refused)
    with pytest.raises(DatasetError):
        read_table(spoiled, file)


def read_table(root, file):
    if file == DATA:
        read_rows(root / file, 0, 14)
    else:
        dataset = LeRobotDataset.__new__(LeRobotDataset)
        dataset.root = root
        _ = {EPISODES: lambda: dataset.rows, schema.TASKS_FILE: lambda: dataset.tasks}.get(
            file, lambda: dataset.described
        )()


def test_a_consistent_lie_about_rows_is_bounded_by_size(tmp_path):
    path = tmp_path / "file.parquet"
    rows = pa.table({"episode_index": pa.array(np.zeros(4_000_000, np.int64))})
    pq.write_table(pa.table({f"{n}": rows.column(0) for n in range(19)} | {"episode_index": rows.column(0)}), path)
    assert path.stat().st_size < 400_000
    with pytest.raises(DatasetError):
        read_rows(path, 0)


def test_a_long_text_that_repeats_is_counted_each_time(tmp_path):
    path = tmp_path / "file.parquet"
    pq.write_table(pa.table({"text": pa.array(["x" * 2**20]).take(pa.array([0] * 100))}), path)
    assert path.stat().st_size < 2**21
    with pytest.raises(DatasetError):
        read_objects(path, {"text": Column(TEXT)})


def test_checksums_name_files_of_the_dataset(spoiled):
    for name in ("../../secret", "/etc/passwd", "data/../../secret", "meta/info.json"):
        edit_json(spoiled, schema.CHECKSUMS_FILE, lambda sums, name=name: sums.update({name: "0" * 64}))
    edit_json(spoiled, schema.CHECKSUMS_FILE, lambda sums: sums.update({DATA: 3}))
    violations = check_lerobot(spoiled)
    assert {violation.file for violation in violations} == {schema.CHECKSUMS_FILE}
    assert len(violations) == 5


@pytest.mark.parametrize("value", [None, 3, "x", [], ["1"] * 7, [None] * 7, [[1]] * 7])
def test_wrong_values_of_statistics(spoiled, value):
    edit_json(spoiled, schema.STATS_FILE, lambda stats: stats["action"].update(min=value))
    edit_json(spoiled, schema.STATS_FILE, lambda stats: stats.update(timestamp=value))
    keys = {violation.key.split(",")[0] for violation in check_lerobot(spoiled)}
    assert keys == {"action", "timestamp"}


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
