"""Locks on output folders: refused processes and leftovers."""

import errno
import fcntl
import os
import threading
from contextlib import ExitStack

import pytest

from robocas_ms3.core.errors import RobocasError
from robocas_ms3.core.files import make_folder
from robocas_ms3.core.locks import lock_folder


def test_new_parent_folders_are_removed_if_the_folder_was_not_created(tmp_path):
    with pytest.raises(ZeroDivisionError), lock_folder(tmp_path / "a" / "b" / "out"):
        _ = 1 / 0
    assert list(tmp_path.iterdir()) == []
    with lock_folder(tmp_path / "a" / "out"):
        make_folder(tmp_path / "a" / "out")
    assert [p.name for p in (tmp_path / "a").iterdir()] == ["out"]


def test_lock_file_removed_between_opening_and_locking(tmp_path, monkeypatch):
    """The process that held the lock removes the file; a lock on the removed file has no effect."""
    lock, flock, calls = tmp_path / ".out.lock", fcntl.flock, []

    def first_removed(*args):
        calls.append(args)
        if len(calls) == 1:
            lock.unlink()
        flock(*args)

    monkeypatch.setattr("fcntl.flock", first_removed)
    with lock_folder(tmp_path / "out"), pytest.raises(RobocasError), lock_folder(tmp_path / "out"):
        pass


def test_lock_file_that_is_a_link_is_not_written_to(tmp_path):
    (tmp_path / "target").write_text("kept")
    (tmp_path / ".out.lock").symlink_to(tmp_path / "target")
    with pytest.raises(RobocasError) as error, lock_folder(tmp_path / "out"):
        pass
    assert error.value.where == tmp_path / ".out.lock"
    os.unlink(tmp_path / ".out.lock")
    os.link(tmp_path / "target", tmp_path / ".out.lock")
    with lock_folder(tmp_path / "out"):
        assert (tmp_path / "target").read_text() == "kept"


@pytest.mark.skipif(not os.access("/proc", os.W_OK), reason="/proc does not look writable here")
def test_folder_that_reports_wrongly_that_it_is_writable():
    with pytest.raises(RobocasError) as error, lock_folder("/proc/out"):
        pass
    assert str(error.value.where) == "/proc"


def test_links_to_a_folder_share_its_lock(tmp_path):
    (tmp_path / "disk").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "disk")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "above").symlink_to(tmp_path)
    for other in (tmp_path / "link", tmp_path / "other" / "above" / "disk"):
        with lock_folder(tmp_path / "disk"), pytest.raises(RobocasError), lock_folder(other):
            pass


def test_locking_waits_for_a_process_that_is_ending(tmp_path):
    holding = ExitStack()
    holding.enter_context(lock_folder(tmp_path / "out"))
    threading.Timer(0.15, holding.close).start()
    with lock_folder(tmp_path / "out"):
        pass


def test_file_system_without_locks_gives_a_warning(tmp_path, monkeypatch, caplog):
    def flock(*_):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr("fcntl.flock", flock)
    with lock_folder(tmp_path / "out"):
        (tmp_path / "out").mkdir()
    (warning,) = caplog.messages
    assert str(tmp_path / "out") in warning
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_disk_error_is_not_reported_as_another_run(tmp_path, monkeypatch):
    def flock(*_):
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr("fcntl.flock", flock)
    with pytest.raises(RobocasError) as error, lock_folder(tmp_path / "out"):
        pass
    assert error.value.found == "Input/output error"
