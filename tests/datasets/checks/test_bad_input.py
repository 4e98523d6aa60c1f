"""RoboCAS folders with pickles: validator, reader, merge and overview writer never load them."""

import numpy as np
import pytest
from managing import Bomb, change, convert_made_up, edit, files_of, make

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets.checks.dataset import validate
from robocas_ms3.datasets.conversion.data_info import write_data_info
from robocas_ms3.datasets.manage.merge import merge
from robocas_ms3.datasets.sources.reader import Dataset


def test_pickles_are_never_loaded(dataset, tmp_path):
    for number, key in ((1, "ee_pos"), (0, "rel_pos")):
        change(dataset / f"episode_{number:07d}", **{key: np.array([Bomb()] * 7, object)})
    camera = dataset / "episode_0000000" / "base_camera" / "intrinsic.npy"
    np.save(camera, np.array([Bomb()], object), allow_pickle=True)
    found = {(violation.file, violation.key) for violation in validate(dataset).violations}
    files = "episode_0000001/episode_info.npz", "episode_0000000/episode_info.npz"
    assert found >= {(files[0], "ee_pos"), (files[1], "rel_pos"), ("episode_0000000/base_camera/intrinsic.npy", "")}
    for read in (
        lambda: Dataset(dataset).episode(1).arrays,
        lambda: Dataset(dataset).episode(0).intrinsic("base_camera"),
        lambda: merge([dataset], tmp_path / "out"),
        lambda: write_data_info(dataset),
    ):
        with pytest.raises(DatasetError):
            read()
    assert Dataset(dataset).episode(0).steps == 7  # other arrays are not concerned
    assert not (tmp_path / "out").exists()


def test_mixed_schema_versions_are_refused(dataset, trajectory):
    edit(dataset / "episode_0000000" / "scene.json", lambda scene: scene.update(schema_version=1))
    (violation,) = validate(dataset).violations
    assert (violation.file, violation.key) == ("episode_0000000/scene.json", "schema_version")
    edit(dataset / "conversion.json", lambda content: content.pop("schema_version"))
    assert "schema_version" in {violation.key for violation in validate(dataset).violations}
    before = files_of(dataset)
    with pytest.raises(DatasetError, match="Convert the recording again"):
        convert_made_up(trajectory, dataset, append=True, embeddings=True)
    assert files_of(dataset) == before


def test_appending_to_a_damaged_dataset_names_the_episode(trajectory, tmp_path):
    root = make(tmp_path, "ds", (1, 2))
    (root / "episode_0000000" / "episode_info.npz").write_bytes(b"PK")
    with pytest.raises(DatasetError, match="episode_0000000"):
        convert_made_up(trajectory, root, append=True)
