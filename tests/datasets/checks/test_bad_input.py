"""RoboCAS folders with damage: what the validator, the reader, the converter and merging say, and what they leave."""

import errno
import json
import os
import shutil

import numpy as np
import pytest
from managing import change, edit, files_of, make, read
from synthetic import RayCaster

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets.checks.dataset import validate
from robocas_ms3.datasets.manage.copying import CopyOptions
from robocas_ms3.datasets.manage.merging import merge
from robocas_ms3.datasets.sources.reader import Dataset
from robocas_ms3.datasets.writing.convert import convert
from robocas_ms3.datasets.writing.info import write_info
from robocas_ms3.datasets.writing.settings import ConversionSettings


class Bomb:
    """Unpickling this is noticed."""

    def __reduce__(self):
        return exec, ("raise SystemExit('unpickled')",)


def violations(root):
    return [str(violation) for violation in validate(root).violations]


@pytest.fixture
def bomb(dataset):
    change(dataset / "episode_0000001", ee_pos=np.array([Bomb()] * 7, object))
    return dataset


def test_pickles_go_off_nowhere(bomb, tmp_path):
    place = "episode_0000001/episode_info.npz, ee_pos"
    assert f"{place}: expected an array without pickles, found pickled objects, which are never loaded" in violations(
        bomb
    )
    with pytest.raises(DatasetError, match="ee_pos: this array can't be read .found pickled objects.*robocas validate"):
        _ = Dataset(bomb).episode(1).arrays
    assert Dataset(bomb).episode(0).steps == 7  # others are not concerned
    change(bomb / "episode_0000000", rel_pos=np.array([Bomb()] * 7, object))
    damaged = "dataset/episode_0000000/episode_info.npz, rel_pos: this episode is damaged .*pickled.*robocas validate"
    with pytest.raises(DatasetError, match=damaged):
        merge([bomb], tmp_path / "out")
    assert not (tmp_path / "out").exists()
    with pytest.raises(DatasetError, match="this episode can't be read"):
        write_info(bomb)


def test_camera_files_with_pickles(dataset):
    path = dataset / "episode_0000000" / "base_camera" / "intrinsic.npy"
    np.save(path, np.array([Bomb()], object), allow_pickle=True)
    with pytest.raises(DatasetError, match="this array can't be read"):
        Dataset(dataset).episode(0).intrinsic("base_camera")
    assert any("base_camera/intrinsic.npy: expected a numpy array" in violation for violation in violations(dataset))


def test_an_episode_twice(dataset):
    shutil.copytree(dataset / "episode_0000001", dataset / "episode_0000002")
    found = violations(dataset)
    assert "episode_0000002: expected each episode once, found the arrays of episode_0000001" in found
    assert "conversion.json, episodes.2: expected an entry of every episode, found none" in found
    edit(dataset / "conversion.json", lambda c: c["episodes"].update({"2": c["episodes"]["1"]}))
    assert "conversion.json, episodes.2: expected each recording once, found that of episode 1" in violations(dataset)


def test_schema_versions_that_are_mixed(dataset, trajectory, tmp_path):
    edit(dataset / "episode_0000000" / "scene.json", lambda scene: scene.update(schema_version=1))
    assert violations(dataset) == ["episode_0000000/scene.json, schema_version: expected 2, found 1"]
    edit(dataset / "conversion.json", lambda content: content.pop("schema_version"))
    expected = "2 (convert it again from its recording)"
    assert f"conversion.json, schema_version: expected {expected}, found 1" in violations(dataset)
    before = files_of(dataset)
    with pytest.raises(DatasetError, match="another schema version .expected 2, found 1.*again from its recording"):
        convert(ConversionSettings(trajectory, dataset, append=True, open_renderer=RayCaster))
    with pytest.raises(DatasetError, match="another schema version"):
        merge([dataset], tmp_path / "out")
    assert files_of(dataset) == before


def test_appending_to_a_damaged_dataset_says_which_episode(trajectory, tmp_path):
    root = make(tmp_path, "ds", (1, 2))
    (root / "episode_0000000" / "episode_info.npz").write_bytes(b"PK")
    with pytest.raises(DatasetError, match=r"episode_0000000.*this episode can't be read.*robocas validate"):
        convert(
            ConversionSettings(trajectory, root, append=True, embeddings=False, video=False, open_renderer=RayCaster)
        )
    assert json.loads((root / "conversion.json").read_text())["episodes"].keys() >= {"0", "1"}


@pytest.mark.parametrize("moment", (0, 60, 119))
def test_a_disk_that_is_full_at_any_file(made, tmp_path, monkeypatch, moment):
    """The same without a small disk: the n-th file does not fit."""
    copyfile, calls = shutil.copyfile, []

    def full(*args, **kwargs):
        calls.append(args)
        if len(calls) > moment:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(args[1]))
        return copyfile(*args, **kwargs)

    out = tmp_path / "out"
    with monkeypatch.context() as patch:
        patch.setattr("shutil.copyfile", full)
        if moment < 106:
            with pytest.raises(OSError, match="No space left"):
                merge([made], out, options=CopyOptions(link=False))
            whole = moment // 53
            if not whole:
                assert not out.exists()
            else:
                assert {path.name for path in out.iterdir()} == {"conversion.json", "episode_0000000"}
                assert files_of(out / "episode_0000000") == files_of(made / "episode_0000000")
    merge([made], out, options=CopyOptions(link=False))
    assert validate(out).violations == []
    assert read(out / "data_info.json") == read(made / "data_info.json")
