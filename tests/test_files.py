import fcntl
import os

import pytest

from robocas_ms3.errors import OutputExistsError, RobocasError
from robocas_ms3.files import claim_output, locked_folder, make_folder, replacing, replacing_folder, write_json


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "a.json"
    write_json(path, {"n": 1})
    with pytest.raises(ZeroDivisionError), replacing(path) as tmp:
        tmp.write_text("half")
        _ = 1 / 0
    assert path.read_text() == '{\n  "n": 1\n}\n'
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"]


def test_a_folder_appears_whole_and_replaces_the_old_one(tmp_path):
    path = tmp_path / "pack"
    with replacing_folder(path) as tmp:
        (tmp / "one").write_text("1")
        assert not path.exists()
    with replacing_folder(path) as tmp:
        (tmp / "two").write_text("2")
    assert [p.name for p in path.iterdir()] == ["two"]
    with pytest.raises(ZeroDivisionError), replacing_folder(path) as tmp:
        _ = 1 / 0
    assert [p.name for p in tmp_path.iterdir()] == ["pack"]


def test_existing_output_needs_a_flag(tmp_path):
    (tmp_path / "out").mkdir()
    claim_output(tmp_path / "out")  # empty: fine
    (tmp_path / "out" / "file").write_text("")
    with pytest.raises(OutputExistsError, match="--resume.*--overwrite"):
        claim_output(tmp_path / "out")
    with pytest.raises(OutputExistsError, match=r"exists already\. Pass --overwrite to replace it\.$"):
        claim_output(tmp_path / "out", resume=None)  # it can't be gone on with
    claim_output(tmp_path / "out", resume=True)
    assert (tmp_path / "out" / "file").exists()
    claim_output(tmp_path / "out", overwrite=True)
    assert list(tmp_path.iterdir()) == []


def test_what_is_overwritten_disappears_at_once(tmp_path, monkeypatch):
    out = tmp_path / "out"
    out.mkdir()
    (out / "file").write_text("")
    with monkeypatch.context() as patch:
        patch.setattr("shutil.rmtree", lambda *_, **__: None)  # as if killed there
        claim_output(out, overwrite=True)
    assert not out.exists()
    (left,) = tmp_path.iterdir()
    assert left.name.startswith(".out.")
    assert left.name.endswith(".old")
    claim_output(out)
    assert list(tmp_path.iterdir()) == []


def test_a_link_to_a_folder_goes_on_leading_to_one(tmp_path):
    (tmp_path / "disk" / "data").mkdir(parents=True)
    (tmp_path / "disk" / "data" / "file").write_text("")
    (tmp_path / "out").symlink_to(tmp_path / "disk" / "data")
    claim_output(tmp_path / "out", overwrite=True)
    assert (tmp_path / "out").is_symlink()
    assert [*(tmp_path / "disk").iterdir(), *(tmp_path / "out").iterdir()] == [tmp_path / "disk" / "data"]


def test_a_folder_that_cannot_be_made_is_one_clear_line(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(RobocasError, match="can't make this folder") as error:
        make_folder(tmp_path / "file" / "sub")
    assert "\n" not in str(error.value)


def test_what_a_killed_run_left_is_swept_up_a_day_later(tmp_path):
    old, young, other = (tmp_path / name for name in (".pack.a.tmp", ".pack.b.tmp", ".spack.c.tmp"))
    for folder in (old, young, other):
        folder.mkdir()
    os.utime(old, (0, 0))
    os.utime(other, (0, 0))
    with replacing_folder(tmp_path / "pack"):
        pass
    assert sorted(p.name for p in tmp_path.iterdir()) == [".pack.b.tmp", ".spack.c.tmp", "pack"]


def test_a_lock_leaves_no_parents_of_a_folder_that_never_was(tmp_path):
    with pytest.raises(ZeroDivisionError), locked_folder(tmp_path / "a" / "b" / "out"):
        _ = 1 / 0
    assert list(tmp_path.iterdir()) == []
    with locked_folder(tmp_path / "a" / "out"):
        make_folder(tmp_path / "a" / "out")
    assert [p.name for p in (tmp_path / "a").iterdir()] == ["out"]


def test_a_lock_that_was_removed_meanwhile_is_none(tmp_path, monkeypatch):
    """The one who held it removes it between another's opening and locking."""
    lock, whole, calls = tmp_path / ".out.lock", fcntl.flock, []

    def flock(*args):
        calls.append(args)
        if len(calls) == 1:
            lock.unlink()
        whole(*args)

    monkeypatch.setattr("fcntl.flock", flock)
    with locked_folder(tmp_path / "out"):
        assert len(calls) == 2
        with pytest.raises(RobocasError, match="another process"), locked_folder(tmp_path / "out"):
            pass


@pytest.mark.skipif(not os.access("/proc", os.W_OK), reason="here it says that it is not writable")
def test_a_lock_in_a_folder_that_only_says_it_is_writable():
    with pytest.raises(RobocasError, match="/proc: can't write into this folder") as error, locked_folder("/proc/out"):
        pass
    assert "\n" not in str(error.value)
