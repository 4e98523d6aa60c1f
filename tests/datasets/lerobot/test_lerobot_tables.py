"""An episode's rows of a file of many."""

import os

import pytest

pq = pytest.importorskip("pyarrow.parquet", reason="needs the extra 'lerobot'")

import pyarrow as pa

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets.lerobot.tables import read_rows

EPISODES = [0] * 3 + [1] * 2 + [3] * 4 + [4]


@pytest.fixture
def rows():
    place = pa.array(range(len(EPISODES)), pa.int64())
    pairs = pa.FixedSizeListArray.from_arrays(pa.array(range(2 * len(EPISODES))), 2)
    return pa.table({"pairs": pairs, "episode_index": pa.array(EPISODES, pa.int64()), "index": place})


@pytest.mark.parametrize("group", [1, 2, 4, 100])
@pytest.mark.parametrize("statistics", [True, False])
def test_rows_are_those_of_the_episode(rows, tmp_path, group, statistics):
    pq.write_table(rows, tmp_path / "file.parquet", row_group_size=group, write_statistics=statistics)
    for number in range(6):
        found = read_rows(tmp_path / "file.parquet", number)
        assert found.schema == rows.schema
        assert found.column("index").to_pylist() == [i for i, of in enumerate(EPISODES) if of == number]


def test_a_file_that_is_replaced_is_read_again(rows, tmp_path):
    path = tmp_path / "file.parquet"
    pq.write_table(rows, path, row_group_size=2)
    assert [len(read_rows(path, number)) for number in (0, 1, 3)] == [3, 2, 4]
    before = path.stat().st_mtime_ns
    pq.write_table(rows.slice(3), path, row_group_size=2)
    os.utime(path, ns=(before + 1, before + 1))
    assert [len(read_rows(path, number)) for number in (0, 1)] == [0, 2]


@pytest.mark.parametrize("other", [{"index": [1, 2]}, {"episode_index": ["one", "two"]}])
def test_a_file_that_does_not_say_whose_rows_are(tmp_path, other):
    pq.write_table(pa.table(other), tmp_path / "file.parquet")
    with pytest.raises(DatasetError):
        read_rows(tmp_path / "file.parquet", 1)
