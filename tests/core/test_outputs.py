"""Whose an output folder is: what is refused, overwritten, locked, swept, and left behind."""

import errno
import fcntl
import os
import threading
from contextlib import ExitStack
from pathlib import Path

import pytest

from robocas_ms3.core.errors import DatasetError, OutputExistsError, RobocasError
from robocas_ms3.core.files import make_folder, replacing_folder
from robocas_ms3.core.outputs import check_overwrite, claim_output, kept_if_begun, locked_folder, sweep, while_there


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


def test_a_lock_that_is_a_link_is_refused_and_leads_nowhere(tmp_path):
    (tmp_path / "target").write_text("kept")
    (tmp_path / ".out.lock").symlink_to(tmp_path / "target")
    with pytest.raises(RobocasError) as error, locked_folder(tmp_path / "out"):
        pass
    assert error.value.where == tmp_path / ".out.lock"
    assert (tmp_path / "target").read_text() == "kept"
    os.unlink(tmp_path / ".out.lock")
    os.link(tmp_path / "target", tmp_path / ".out.lock")
    with locked_folder(tmp_path / "out"):
        assert (tmp_path / "target").read_text() == "kept"  # of another name of the file, too


@pytest.mark.skipif(not os.access("/proc", os.W_OK), reason="here it says that it is not writable")
def test_a_lock_in_a_folder_that_only_says_it_is_writable():
    with pytest.raises(RobocasError, match="/proc: can't write into this folder") as error, locked_folder("/proc/out"):
        pass
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("error", [OutputExistsError, DatasetError])
def test_only_what_is_ours_is_overwritten(tmp_path, error):
    check_overwrite(tmp_path / "none", ("run.json",), "a run", error)
    check_overwrite(tmp_path, ("run.json",), "a run", error)  # empty
    (tmp_path / "thesis").write_text("")
    for path in (tmp_path, tmp_path / "thesis"):
        with pytest.raises(error, match=r"refusing to overwrite what is not a run .expected run\.json or parts"):
            check_overwrite(path, ("run.json", "parts"), "a run", error)
    (tmp_path / "parts").mkdir()
    check_overwrite(tmp_path, ("run.json", "parts"), "a run", error)


def test_what_was_left_half_written_is_swept(tmp_path):
    for name in (".a.1.tmp.png", ".b.tmp", "kept.tmp", ".c.old"):
        (tmp_path / name).mkdir() if name == ".b.tmp" else (tmp_path / name).touch()
    (tmp_path / "disk").mkdir()
    (tmp_path / "disk" / "file").touch()
    (tmp_path / ".link.tmp").symlink_to(tmp_path / "disk")
    sweep(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["disk", "kept.tmp"]
    assert (tmp_path / "disk" / "file").exists()  # of a link, the link alone goes


@pytest.mark.parametrize("begun", [False, True])
def test_a_folder_of_which_nothing_came_goes(tmp_path, begun):
    parts = make_folder(tmp_path / "out" / "parts")
    with pytest.raises(KeyboardInterrupt), kept_if_begun(tmp_path / "out", parts, "part_*"):
        if begun:
            (parts / "part_0").touch()
        raise KeyboardInterrupt
    assert (tmp_path / "out").exists() is begun


def test_one_lock_whatever_links_lead_to_a_folder(tmp_path):
    (tmp_path / "disk").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "disk")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "above").symlink_to(tmp_path)
    for other in (tmp_path / "link", tmp_path / "other" / "above" / "disk"):
        refused = pytest.raises(RobocasError, match="another process is writing here")
        with locked_folder(tmp_path / "disk"), refused, locked_folder(other):
            pass


def test_a_lock_that_is_about_to_go_is_waited_for(tmp_path):
    holding = ExitStack()
    holding.enter_context(locked_folder(tmp_path / "out"))
    threading.Timer(0.15, holding.close).start()
    with locked_folder(tmp_path / "out") as held:
        assert held


@pytest.fixture
def fixed(tmp_path, monkeypatch):
    """A folder that can be written into but neither renamed nor have anything beside it, as a container mounts it."""
    out = tmp_path / "out"
    out.mkdir()
    whole, access = os.replace, os.access

    def replace(source, target):
        if out in (Path(source), Path(target)) or tmp_path in (Path(source).parent, Path(target).parent):
            raise OSError(errno.EROFS, "Read-only file system")
        whole(source, target)

    monkeypatch.setattr("os.access", lambda path, mode: Path(path) != tmp_path and access(path, mode))
    monkeypatch.setattr("os.replace", replace)
    return out


def test_a_folder_with_nothing_beside_it_is_locked_and_emptied_where_it_is(fixed):
    (fixed / "episode_0").mkdir()
    (fixed / "run.json").touch()
    with locked_folder(fixed):
        with pytest.raises(RobocasError, match="another process"), locked_folder(fixed):
            pass
        with pytest.raises(OutputExistsError):
            claim_output(fixed)
        claim_output(fixed, overwrite=True)
        claim_output(fixed)  # its lock is no content
    assert list(fixed.iterdir()) == []


def test_a_folder_with_nothing_beside_it_is_replaced_from_within(fixed):
    (fixed / "old").touch()
    with pytest.raises(ZeroDivisionError), replacing_folder(fixed) as folder:
        (folder / "new").touch()
        _ = 1 / 0
    assert [path.name for path in fixed.iterdir()] == ["old"]
    with replacing_folder(fixed) as folder:
        (folder / "new").mkdir()
    assert [path.name for path in fixed.iterdir()] == ["new"]


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.EOPNOTSUPP])
def test_a_file_system_without_locks_is_said_and_gone_on_without(tmp_path, monkeypatch, caplog, number):
    def flock(*_):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr("fcntl.flock", flock)
    with locked_folder(tmp_path / "out") as held:
        assert held is False
        (tmp_path / "out").mkdir()
    (said,) = caplog.messages
    assert f"{tmp_path}/out: its file system has no locks ({os.strerror(number)})" in said
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_a_lock_that_fails_otherwise_blames_no_other_run(tmp_path, monkeypatch):
    def flock(*_):
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr("fcntl.flock", flock)
    with pytest.raises(RobocasError, match=r"out: can't lock this folder \(found Input/output error\)"):  # noqa: SIM117
        with locked_folder(tmp_path / "out"):
            pass


def test_a_file_that_is_missed_is_the_fault_of_who_removed_the_folder(tmp_path):
    mark = tmp_path / "out" / "run.json"
    make_folder(mark.parent)
    mark.touch()
    with pytest.raises(FileNotFoundError), while_there(mark, DatasetError):  # a mistake of ours remains one
        (mark.parent / "none").read_text()
    mark.unlink()
    said = r"out: the output folder is gone, or emptied.*\(expected run.json\)"
    with pytest.raises(DatasetError, match=said), while_there(mark, DatasetError):
        mark.read_text()
