"""Arrays of an episode: errors are recorded, and repairs do not change their input."""

import numpy as np
import pytest
from managing import arrays_of, change

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.checks import arrays as array_checks
from robocas_ms3.datasets.manage.repairs import ImportedEpisode, repair_arrays
from robocas_ms3.datasets.sources.arrays import EpisodeArrays, load_arrays, read_arrays

FILE = "episode_0000001/episode_info.npz"


def said(violations):
    return [(violation.key, violation.expected, violation.found) for violation in violations]


def test_unreadable_arrays_are_recorded_and_refused_on_access(dataset):
    episode = dataset / "episode_0000001"
    change(episode, ee_pos=np.array([{}] * 7, object), speed=np.zeros(3))
    stored = read_arrays(episode / "episode_info.npz")
    assert (stored.file, stored.steps, list(stored.unreadable)) == (FILE, 7, ["ee_pos"])
    assert stored.describe_error("ee_pos") == "pickled objects, which are never loaded"
    assert "speed" in stored.arrays
    with pytest.raises(DatasetError, match="episode_info.npz, ee_pos: this episode can't be read .*pickled"):
        stored.require(["rel_pos"])
    some = read_arrays(episode / "episode_info.npz", ("rel_pos", "none"))
    assert list(some.arrays) == ["rel_pos"] and "speed" in some.ignored
    with pytest.raises(DatasetError, match="arrays are missing .expected none"):
        some.require(["rel_pos", "none"])


def test_missing_file(tmp_path):
    stored = read_arrays(tmp_path / "episode_info.npz")
    assert (stored.steps, list(stored.unreadable)) == (0, [""])
    assert said(array_checks.run_checks(stored, array_checks.FORM_CHECKS)) == [("", "this file", "no file")]
    with pytest.raises(DatasetError, match="this episode can't be read .found No such file"):
        stored.require([])
    with pytest.raises(DatasetError, match="no such file"):
        load_arrays(tmp_path / "episode_info.npz")


def test_missing_arrays_violate_one_rule_only(tmp_path):
    empty = EpisodeArrays(tmp_path, {})
    assert (
        said(
            array_checks.run_checks(
                empty,
                (
                    array_checks.check_shapes,
                    array_checks.check_finite,
                    array_checks.check_unit_length,
                    *array_checks.CONTENT_CHECKS,
                ),
            )
        )
        == []
    )
    absent = [key for key, *_ in said(array_checks.check_keys(empty))]
    assert absent == [spec.name for spec in schema.EPISODE_INFO if not (spec.embedding or spec.optional)]


def test_repairs_do_not_change_their_input(made):
    episode = made / "episode_0000001"
    arrays = arrays_of(episode)
    arrays |= {key: np.roll(arrays[key], 1, axis=0) for key in ("rel_pos", "rel_orn")}
    arrays |= {"rel_agv_pose": arrays["rel_agv_pose"] + 1, "language_embedding": np.ones(384, "f4")}
    before = {key: array.copy() for key, array in arrays.items()}
    stored = EpisodeArrays(episode / "episode_info.npz", arrays)
    repaired = ImportedEpisode(1, stored)
    repair_arrays(repaired)
    assert [(finding.violation.key, finding.outcome) for finding in repaired.findings] == [
        ("language_embedding", "warning"),
        ("rel_pos", "repaired"),
        ("rel_orn", "repaired"),
        ("rel_agv_pose", "repaired"),
    ]
    assert list(stored.arrays) == list(before)
    for key, array in before.items():
        np.testing.assert_array_equal(stored.arrays[key], array)
    again = ImportedEpisode(1, repaired.stored)
    repair_arrays(again)
    assert again.findings == []
    assert "language_embedding" not in again.stored.arrays
