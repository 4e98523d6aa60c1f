"""``candidates.h5``: values survive, files are merged, and untrusted files are rejected."""

# pyright: reportAttributeAccessIssue=false, reportIndexIssue=false
import os
import signal

import h5py
import numpy as np
import pytest
from synthetic_candidates import ENV_INFO, SETTINGS, make_record, write_episodes

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.demos.candidates.candidates_file import (
    CandidateFile,
    is_candidates_file,
    merge_candidates,
    write_candidates,
)
from robocas_ms3.demos.candidates.schema import CANDIDATE_FIELDS, DECISION_FIELDS

SECRET = np.arange(12, dtype=np.float32).reshape(2, 6)


def test_values_of_records_are_read_back(tmp_path):
    records = [make_record(3, 0, candidates=3), make_record(3, 1, candidates=0), make_record(3, 2, candidates=5)]
    write_candidates(tmp_path / "c.h5", records, ENV_INFO, SETTINGS)
    file = CandidateFile(tmp_path / "c.h5")
    assert list(file.decisions) == [field.name for field in DECISION_FIELDS]
    assert list(file.candidates) == [field.name for field in CANDIDATE_FIELDS]
    assert file.decisions["candidate_count"].tolist() == [3, 0, 5]
    assert file.decisions["first_candidate"].tolist() == [0, 3, 3]
    assert file.candidates["decision_row"].tolist() == [0, 0, 0, 2, 2, 2, 2, 2]
    for row, record in enumerate(records):
        decision = file.decision(row)
        for name, value in record.values.items():
            np.testing.assert_array_equal(decision.values[name], np.asarray(value, decision.values[name].dtype))
        for index, candidate in enumerate(record.candidates):
            for name, value in candidate.items():
                found = decision.candidates[name]
                np.testing.assert_array_equal(found[index], np.asarray(value, found.dtype), err_msg=name)
        for kind, bodies in record.state.items():
            assert file.state(row)[kind].keys() == bodies.keys()
            for name, value in bodies.items():
                found = file.state(row)[kind][name]
                assert found.dtype == value.dtype
                np.testing.assert_array_equal(found[0], value)
    assert (file.env_info, file.settings) == (ENV_INFO, SETTINGS)
    assert file.recorded_env.kwargs["config"] == "search_table_stacked"
    assert "robocas-ms3" in file.versions
    for row in (-1, 3):
        with pytest.raises(DatasetError):
            file.decision(row)


def test_episode_without_decisions(tmp_path):
    write_candidates(tmp_path / "a.h5", [], ENV_INFO, SETTINGS)
    assert len(CandidateFile(tmp_path / "a.h5")) == 0
    merge_candidates([tmp_path / "a.h5", write_episodes(tmp_path / "b.h5", seeds=(3,))], tmp_path / "c.h5")
    assert CandidateFile(tmp_path / "c.h5").decisions["seed"].tolist() == [3, 3]


def test_texts_are_unicode(tmp_path):
    record = make_record(3, 0)
    record.values["instruction"] = "取出螺丝刀 – "
    write_candidates(tmp_path / "c.h5", [record], ENV_INFO, SETTINGS)
    assert CandidateFile(tmp_path / "c.h5").decisions["instruction"].tolist() == ["取出螺丝刀 – "]


def without_a_value(record):
    del record.values["step"]


def with_too_many_values(record):
    record.candidates[0]["start_in_base"] = np.zeros(8)


@pytest.mark.parametrize("damage", [without_a_value, with_too_many_values])
def test_incomplete_records_are_not_written(tmp_path, damage):
    record = make_record(3, 0)
    damage(record)
    with pytest.raises(DatasetError):
        write_candidates(tmp_path / "c.h5", [record], ENV_INFO, SETTINGS)
    assert list(tmp_path.iterdir()) == []


def test_merged_files_equal_one_file(tmp_path):
    parts = [write_episodes(tmp_path / f"{seed}.h5", seeds=(seed,)) for seed in (7, 3, 5)]
    merge_candidates(parts, tmp_path / "merged.h5")
    write_episodes(tmp_path / "whole.h5", seeds=(7, 3, 5))
    assert (tmp_path / "merged.h5").read_bytes() == (tmp_path / "whole.h5").read_bytes()


def test_slots_and_bodies_are_padded(tmp_path):
    records = make_record(7, 0, slots=3), make_record(3, 0, slots=5)
    records[1].state["articulations"] = {
        "robocas_mobile_panda": np.arange(40, dtype=np.float32),
        "cabinet": np.ones(15, np.float32),
    }
    for record in records:
        write_candidates(tmp_path / f"{record.values['seed']}.h5", [record], ENV_INFO, SETTINGS)
    merge_candidates([tmp_path / "7.h5", tmp_path / "3.h5"], tmp_path / "c.h5")
    file = CandidateFile(tmp_path / "c.h5")
    assert file.decisions["present"].tolist() == [[True] * 3 + [False] * 2, [True] * 5]
    assert file.decisions["object_id"][0, 3:].tolist() == ["", ""]
    assert np.isnan(file.decisions["object_in_base"][0, 3:]).all()
    assert file.candidates["obstacles"][0, 3:].tolist() == [-1, -1]
    assert not file.candidates["fallen"][0, 3:].any()
    for row, record in enumerate(records):
        state = file.state(row)
        assert {kind: {*bodies} for kind, bodies in state.items()} == {
            kind: {*bodies} for kind, bodies in record.state.items()
        }
        for name, value in record.state["articulations"].items():
            np.testing.assert_array_equal(state["articulations"][name][0], value)


def test_merge_takes_each_seed_once_and_can_be_repeated(tmp_path):
    first = write_episodes(tmp_path / "1.h5", seeds=(3, 4))
    second = write_episodes(tmp_path / "2.h5", seeds=(4, 5), decisions=1)
    for _ in range(2):
        merge_candidates([first, second], tmp_path / "c.h5")
        file = CandidateFile(tmp_path / "c.h5")
        assert file.decisions["seed"].tolist() == [3, 3, 4, 4, 5]
        assert len(file.candidates["slot"]) == 5 * 6
    merge_candidates([write_episodes(tmp_path / "3.h5", seeds=(9,))], tmp_path / "c.h5")
    assert CandidateFile(tmp_path / "c.h5").decisions["seed"].tolist() == [3, 3, 4, 4, 5, 9, 9]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["1.h5", "2.h5", "3.h5", "c.h5"]


def test_file_does_not_depend_on_the_number_of_merges(tmp_path):
    parts = [write_episodes(tmp_path / f"{seed}.h5", seeds=(seed,), slots=12) for seed in (7, 3, 5)]
    merge_candidates(parts, tmp_path / "once.h5")
    merge_candidates(parts[:2], tmp_path / "twice.h5")
    merge_candidates(parts[2:], tmp_path / "twice.h5")
    assert (tmp_path / "once.h5").read_bytes() == (tmp_path / "twice.h5").read_bytes()


@pytest.mark.parametrize("moment", ["before the rename", "after the rename"])
def test_merge_after_a_kill_gives_the_same_file(tmp_path, moment):
    parts = [write_episodes(tmp_path / f"{seed}.h5", seeds=(seed,)) for seed in (7, 3)]
    merge_candidates(parts, tmp_path / "whole.h5")
    child = os.fork()
    if child == 0:
        replace = os.replace

        def replace_and_die(source, target):
            if moment == "after the rename":
                replace(source, target)
            os.kill(os.getpid(), signal.SIGKILL)

        os.replace = replace_and_die
        merge_candidates(parts, tmp_path / "c.h5")
        os._exit(0)
    assert os.WTERMSIG(os.waitpid(child, 0)[1]) == signal.SIGKILL
    assert (tmp_path / "c.h5").exists() == (moment == "after the rename")
    merge_candidates(parts, tmp_path / "c.h5")
    assert (tmp_path / "c.h5").read_bytes() == (tmp_path / "whole.h5").read_bytes()


def test_different_environments_are_not_merged(tmp_path):
    first = write_episodes(tmp_path / "1.h5")
    other = {**ENV_INFO, "env_kwargs": {**ENV_INFO["env_kwargs"], "config": "pick_table_scattered"}}
    write_candidates(tmp_path / "2.h5", [make_record(9, 0)], other, SETTINGS)
    with pytest.raises(DatasetError) as error:
        merge_candidates([first, tmp_path / "2.h5"], tmp_path / "c.h5")
    assert error.value.where == tmp_path / "2.h5"
    assert not (tmp_path / "c.h5").exists()


def test_candidates_with_other_noise_are_not_merged(tmp_path):
    first = write_episodes(tmp_path / "1.h5")
    write_candidates(tmp_path / "2.h5", [make_record(9, 0)], ENV_INFO, {**SETTINGS, "action_noise": [3.0, 1.0]})
    with pytest.raises(DatasetError):
        merge_candidates([str(first), str(tmp_path / "2.h5")], str(tmp_path / "c.h5"))


def replaced(path, name, fill):
    with h5py.File(path, "r+") as file:
        del file[name]
        fill(file, name)


def external_link(file, name):
    file[name] = h5py.ExternalLink("secret.h5", "values")


def soft_link(file, name):
    file[name] = h5py.SoftLink("/decisions/present")


def external_values(file, name):
    file.create_dataset(name, SECRET.shape, np.float32, external=[("secret.bin", 0, SECRET.nbytes)])


def virtual(file, name):
    layout = h5py.VirtualLayout(SECRET.shape, np.float32)
    layout[:] = h5py.VirtualSource("secret.h5", "values", SECRET.shape)
    file.create_virtual_dataset(name, layout)


def missing(file, name):
    pass


def other_type(file, name):
    file[name] = np.zeros(4, np.float64)


def other_rows(file, name):
    file[name] = np.zeros((3, 7), np.float32)


def terabytes(file, name):
    file.create_dataset(name, (2**20, 2**10, 7), np.float32, chunks=(1, 2**10, 7))


def compound(file, name):
    file[name] = np.zeros(4, [("a", "f4")])


@pytest.mark.parametrize(
    "fill",
    [external_link, soft_link, external_values, virtual, missing, other_type, other_rows, terabytes, compound],
)
@pytest.mark.parametrize("name", ["decisions/tcp_in_base", "candidates/start_in_base", "states/actors/object_1"])
def test_damaged_files_are_rejected(tmp_path, fill, name):
    path = write_episodes(tmp_path / "c.h5")
    (tmp_path / "secret.bin").write_bytes(SECRET.tobytes())
    replaced(path, name, fill)
    if (fill, name.split("/")[0]) == (missing, "states"):
        assert "object_1" not in CandidateFile(path).state(0)["actors"]
        return
    with pytest.raises(DatasetError) as error:
        CandidateFile(path)
    assert str(error.value.where).startswith(str(path))


@pytest.mark.parametrize("field", ["decisions/first_candidate", "decisions/candidate_count", "candidates/decision_row"])
def test_rows_of_candidates_must_be_consecutive(tmp_path, field):
    path = write_episodes(tmp_path / "c.h5")
    with h5py.File(path, "r+") as file:
        file[field][0] = 2**30
    with pytest.raises(DatasetError):
        CandidateFile(path)


@pytest.mark.parametrize(
    ("field", "value"),
    [("decisions/kind", b"x"), ("decisions/target_slot", -1), ("decisions/held_slot", 5), ("candidates/slot", 5)],
)
def test_words_and_slots_are_checked(tmp_path, field, value):
    path = write_episodes(tmp_path / "c.h5")
    with h5py.File(path, "r+") as file:
        file[field][1] = value
    with pytest.raises(DatasetError) as error:
        CandidateFile(path)
    assert str(error.value.where) == f"{path}, {field}, row 1"
    assert len(CandidateFile(path, strict=False)) == 4


@pytest.mark.parametrize("content", [None, b"", b"not HDF5"])
def test_file_must_be_hdf5(tmp_path, content):
    path = tmp_path / "c.h5"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(DatasetError) as error:
        CandidateFile(path)
    assert error.value.where == path


@pytest.mark.parametrize(("name", "value"), [("format", "x"), ("format", b"x"), ("version", 2), ("version", "x")])
def test_format_and_version_are_checked(tmp_path, name, value):
    path = write_episodes(tmp_path / "c.h5")
    assert is_candidates_file(path)
    with h5py.File(path, "r+") as file:
        file.attrs[name] = value
    with pytest.raises(DatasetError):
        CandidateFile(path)
    assert is_candidates_file(path) == (name != "format")


@pytest.mark.parametrize("value", [b"{", b"3", "{}", np.zeros(3)])
@pytest.mark.parametrize("name", ["env_info", "settings"])
def test_metadata_is_checked(tmp_path, name, value):
    path = write_episodes(tmp_path / "c.h5")
    with h5py.File(path, "r+") as file:
        del file[name]
        file[name] = value
    with pytest.raises(DatasetError):
        CandidateFile(path)


def test_long_metadata(tmp_path):
    settings = {"text": "x" * 100_000}  # HDF5 attributes are limited to 64 kB
    write_candidates(tmp_path / "c.h5", [make_record(3, 0)], ENV_INFO, settings)
    assert CandidateFile(tmp_path / "c.h5").settings == settings


def test_truncated_file_is_rejected(tmp_path):
    path = write_episodes(tmp_path / "c.h5")
    os.truncate(path, path.stat().st_size - 1)
    with pytest.raises(DatasetError):
        CandidateFile(path)


def test_folder_contains_the_file(tmp_path):
    write_episodes(tmp_path / "candidates.h5")
    assert CandidateFile(tmp_path).path == tmp_path / "candidates.h5"
