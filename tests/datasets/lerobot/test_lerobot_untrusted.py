"""Files of wrong types, sizes and kinds: the checker reports them and the reader refuses them."""

from contextlib import suppress

import numpy as np
import pytest
from irregular import KINDS, replace_file
from lerobot_folders import DATA, DEPTH, EPISODES, VIDEO, edit_json

pytest.importorskip("av", reason="needs the extra 'lerobot'")
pa = pytest.importorskip("pyarrow", reason="needs the extra 'lerobot'")
pq = pytest.importorskip("pyarrow.parquet", reason="needs the extra 'lerobot'")

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets.lerobot import schema
from robocas_ms3.datasets.lerobot.check import check_lerobot
from robocas_ms3.datasets.lerobot.reader import LeRobotDataset
from robocas_ms3.datasets.lerobot.tables import TEXT, Column, read_episode_rows, read_small_table


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("codebase_version", "v2.0"),
        ("chunks_size", 0),
        *(("fps", value) for value in (5.5, 0)),
        ("total_frames", 2**62),
        ("data_path", "../{chunk_index}/{file_index:9999999999d}"),
        ("video_path", "{video_key.__class__}"),
        ("video_path", None),
        ("features", 3),
        ("features.action", {"dtype": "float32"}),
        ("features.action.shape", [2**40]),
        ("features.action.shape", [6]),
        ("features.action.dtype", "object"),
        ("features.frame_index", None),
    ],
)
def test_wrong_values_in_info_json(spoiled, key, value):
    def edit(info):
        *way, last = key.split(".", 2)
        for name in way:
            info = info[name]
        info[last] = value

    edit_json(spoiled, "meta/info.json", edit)
    violations = check_lerobot(spoiled).violations
    assert {violation.file for violation in violations} == {"meta/info.json"}
    assert any(key in violation.key + violation.expected for violation in violations)
    if key != "features.action.shape" or value != [6]:
        with pytest.raises(DatasetError):
            LeRobotDataset(spoiled)


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
        (EPISODES, "tasks", "structures"),
        (EPISODES, "videos/observation.images.base_camera/file_index", "huge"),
        (EPISODES, "videos/observation.images.base_camera/from_timestamp", "NaN"),
        (DATA, "episode_index", "strings"),
        (DATA, "timestamp", "NaN"),
        (DATA, "subtask_index", "huge"),
        (DATA, "action", "ragged lists"),
        (schema.TASKS_FILE, "task_index", "negative"),
        (schema.SUBTASKS_FILE, "subtask_index", "ragged lists"),
        (schema.SCENES_FILE, "cameras", "structures"),
    ],
)
def test_wrong_values_in_columns(spoiled, file, key, wrong):
    table_of(spoiled, file, key, WRONG[wrong])
    assert [violation for violation in check_lerobot(spoiled).violations if "SHA-256" not in violation.expected]
    unused = key == "timestamp"
    with suppress(DatasetError) if unused else pytest.raises(DatasetError):
        read_all(spoiled)


@pytest.mark.parametrize("dtype", ["uint8", "bool", "string"])
def test_stored_types_other_than_declared(spoiled, dtype):
    edit_json(spoiled, schema.INFO_FILE, lambda info: info["features"]["action"].update(dtype=dtype))
    assert (DATA, "action") in {(violation.file, violation.key) for violation in check_lerobot(spoiled).violations}
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
    assert [violation.file for violation in check_lerobot(spoiled).violations] == [expected]
    if name != schema.STATS_FILE:
        with pytest.raises(DatasetError):
            read_all(spoiled)


@pytest.mark.parametrize("count", [0, 10**6])
def test_totals_that_differ_from_the_tables(spoiled, count):
    totals = "total_episodes", "total_tasks", "total_frames"
    edit_json(spoiled, schema.INFO_FILE, lambda info: info.update(dict.fromkeys(totals, count)))
    found = [(violation.file, violation.key) for violation in check_lerobot(spoiled).violations]
    assert found == [(schema.INFO_FILE, key) for key in totals]


def read_all(root):
    dataset = LeRobotDataset(root)
    assert dataset.tasks
    for number in dataset.numbers:
        episode = dataset.episode(number)
        assert episode.arrays
        assert episode.goals
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
    dataset = LeRobotDataset(spoiled)
    read = {
        DATA: lambda: read_episode_rows(spoiled / file, 0, 14),
        EPISODES: lambda: dataset.rows,
        schema.TASKS_FILE: lambda: dataset.tasks,
        schema.SCENES_FILE: lambda: dataset.scene_json_texts,
    }
    with pytest.raises(DatasetError):
        read[file]()


def test_wrong_row_counts_are_bounded_by_size(tmp_path):
    path = tmp_path / "file.parquet"
    rows = pa.table({"episode_index": pa.array(np.zeros(4_000_000, np.int64))})
    pq.write_table(pa.table({f"{n}": rows.column(0) for n in range(19)} | {"episode_index": rows.column(0)}), path)
    assert path.stat().st_size < 400_000
    with pytest.raises(DatasetError):
        read_episode_rows(path, 0)


def test_repeated_long_text_counts_each_time(tmp_path):
    path = tmp_path / "file.parquet"
    pq.write_table(pa.table({"text": pa.array(["x" * 2**20]).take(pa.array([0] * 100))}), path)
    assert path.stat().st_size < 2**21
    with pytest.raises(DatasetError):
        read_small_table(path, {"text": Column(TEXT)})


def test_checksums_name_files_of_the_dataset(spoiled):
    for name in ("../../secret", "/etc/passwd", "data/../../secret", "meta/info.json"):
        edit_json(spoiled, schema.CHECKSUMS_FILE, lambda sums, name=name: sums.update({name: "0" * 64}))
    edit_json(spoiled, schema.CHECKSUMS_FILE, lambda sums: sums.update({DATA: 3}))
    violations = check_lerobot(spoiled).violations
    assert [violation.file for violation in violations] == [DATA, *[schema.CHECKSUMS_FILE] * 4]


@pytest.mark.parametrize("value", [None, "x", [None] * 7, [[1]] * 7])
def test_wrong_values_of_statistics(spoiled, value):
    edit_json(spoiled, schema.STATS_FILE, lambda stats: stats["action"].update(min=value))
    edit_json(spoiled, schema.STATS_FILE, lambda stats: stats.update(timestamp=value))
    keys = {violation.key.split(",")[0] for violation in check_lerobot(spoiled).violations}
    assert keys == {"action", "timestamp"}
