"""`prepare` on a small LeRobot export."""

# ruff: noqa: E402

import json
import shutil

import numpy as np
import pytest
from synthetic import RayCaster, write_trajectory

pytest.importorskip("av", reason="needs the extra 'lerobot'")
pa = pytest.importorskip("pyarrow", reason="needs the extra 'lerobot'")
pq = pytest.importorskip("pyarrow.parquet", reason="needs the extra 'lerobot'")

from robocas_ms3.baselines.lerobot import prepare as module
from robocas_ms3.baselines.lerobot.policy import EMBEDDING, STATE_NAMES
from robocas_ms3.baselines.lerobot.prepare import main, prepare_dataset
from robocas_ms3.core.errors import DatasetError, OutputExistsError
from robocas_ms3.datasets.conversion.settings import ConversionSettings
from robocas_ms3.datasets.lerobot.convert import convert_lerobot
from robocas_ms3.robots.quantities import STATE

DATA = "data/chunk-000/file-000.parquet"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """Return an export of two episodes with different instructions."""
    folder = tmp_path_factory.mktemp("source")
    convert_lerobot(
        ConversionSettings(write_trajectory(folder / "F.h5", seeds=(3, 4)), folder / "dataset", open_renderer=RayCaster)
    )
    return folder / "dataset"


def embed(texts):
    """Return unit vectors whose nonzero component is the seed in the instruction."""
    return np.stack([np.eye(384, dtype=np.float32)[int(text.split()[3])] for text in texts])


def numbers(path, key):
    return np.array(pq.read_table(path)[key].to_pylist())


@pytest.fixture
def out(source, tmp_path):
    prepare_dataset(source, tmp_path / "out", embed)
    return tmp_path / "out"


def test_columns_are_those_of_the_policy_socket(source, out):
    was, now = pq.read_table(source / DATA), pq.read_table(out / DATA)
    assert set(now.column_names) == {
        *(STATE, EMBEDDING, "action", "timestamp", "frame_index", "episode_index", "index", "task_index")
    }
    assert now["action"].to_pylist() == was["action"].to_pylist()
    old, new = numbers(source / DATA, STATE), numbers(out / DATA, STATE)
    np.testing.assert_allclose(new[:, :3], old[:, :3])
    np.testing.assert_allclose(new[:, 9:], old[:, 7:15])
    x, y, z, w = old[:, 3:7].T  # first column of the rotation matrix
    np.testing.assert_allclose(
        new[:, 3:6].T, [1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)], atol=1e-6
    )


def test_instructions_are_those_of_their_frames(out):
    table = pq.read_table(out / DATA)
    vectors = np.array(table[EMBEDDING].to_pylist())
    where = vectors.argmax(axis=1)
    assert np.unique(where).tolist() == [3, 4]
    assert (where == np.array(table["episode_index"]) + 3).all()
    assert vectors.max() == pytest.approx(19.5959, abs=1e-4)


def test_meta_agrees_with_the_columns(source, out):
    info = json.loads((out / "meta/info.json").read_text())
    assert info["features"][STATE] == {"dtype": "float32", "shape": [17], "names": list(STATE_NAMES)}
    assert info["features"][EMBEDDING]["shape"] == [384]
    assert "action.joint" not in info["features"]
    assert info["fps"] == json.loads((source / "meta/info.json").read_text())["fps"]
    stats = json.loads((out / "meta/stats.json").read_text())
    assert set(stats) <= set(info["features"])
    state = numbers(out / DATA, STATE)
    np.testing.assert_allclose(stats[STATE]["mean"], state.mean(axis=0), atol=1e-6)
    np.testing.assert_allclose(stats[STATE]["q50"], np.median(state, axis=0), atol=1e-6)
    assert stats[STATE]["count"] == [len(state)]
    assert not [name for name in pq.read_table(out / EPISODES).column_names if name.startswith("stats/")]


def test_videos_are_the_same_files(source, out):
    videos, there = ({path.relative_to(root) for path in root.rglob("*.mp4")} for root in (out, source))
    assert videos == {path for path in there if "_depth" not in str(path)}
    assert videos < there
    assert all((out / path).samefile(source / path) for path in videos)
    info = json.loads((out / "meta/info.json").read_text())
    assert not [key for key in info["features"] if "depth" in key or "language" in key]
    assert not [name for name in pq.read_table(out / EPISODES).column_names if "depth" in name]
    assert not (out / ".annotate_staging").exists()
    with pytest.raises(OutputExistsError):
        prepare_dataset(source, out, embed)


@pytest.mark.parametrize("key, value", [("action", np.nan), ("action.base", 0.02)])
def test_nan_and_base_motion_are_refused(source, tmp_path, key, value):
    spoiled = tmp_path / "spoiled"
    shutil.copytree(source, spoiled)
    table = pq.read_table(spoiled / DATA)
    values = numbers(spoiled / DATA, key).astype(np.float32)
    values[2, 1] = value
    column = pa.FixedSizeListArray.from_arrays(pa.array(values.reshape(-1)), values.shape[1])
    pq.write_table(table.set_column(table.column_names.index(key), key, column), spoiled / DATA)
    with pytest.raises(DatasetError):
        prepare_dataset(spoiled, tmp_path / "out", embed)
    assert not (tmp_path / "out").exists()


def test_other_datasets_are_one_line_errors(source, tmp_path, capsys):
    convert_lerobot(ConversionSettings(source, tmp_path / "old", lerobot_version="2.1"))
    for path in (tmp_path, tmp_path / "old"):
        assert main([str(path), str(tmp_path / "out"), "--no-language"]) == 1
        said = capsys.readouterr().err
        assert said.count("\n") == 1 and str(path) in said
    assert not (tmp_path / "out").exists()


def test_videos_are_copied_without_hard_links(source, tmp_path, monkeypatch):
    def refuse(*_):
        raise OSError("no links here")

    monkeypatch.setattr(module.os, "link", refuse)
    prepare_dataset(source, tmp_path / "out", None)  # without language
    assert EMBEDDING not in pq.read_table(tmp_path / "out" / DATA).column_names
    assert EMBEDDING not in json.loads((tmp_path / "out/meta/info.json").read_text())["features"]
    for path in (path for path in source.rglob("*.mp4") if "_depth" not in str(path)):
        copy = tmp_path / "out" / path.relative_to(source)
        assert copy.read_bytes() == path.read_bytes()
        assert not copy.samefile(path)
