import errno
import os
from pathlib import Path

import pytest

from robocas_ms3.core import files
from robocas_ms3.core.documents import load_json
from robocas_ms3.core.errors import RobocasError
from robocas_ms3.core.files import (
    add_path_to_errors,
    atomic_file,
    atomic_folder,
    make_folder,
    open_for_append,
    write_json,
)


def test_a_failed_write_keeps_the_old_file_and_leaves_no_temporary_file(tmp_path):
    path = tmp_path / "a.json"
    write_json(path, {"n": 1})
    with pytest.raises(ZeroDivisionError), atomic_file(path) as tmp:
        tmp.write_text("half")
        _ = 1 / 0
    assert path.read_text() == '{\n  "n": 1\n}\n'
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"]


def test_atomic_folder_replaces_the_old_folder(tmp_path):
    path = tmp_path / "pack"
    with atomic_folder(path) as tmp:
        (tmp / "one").write_text("1")
        assert not path.exists()
    with atomic_folder(path) as tmp:
        (tmp / "two").write_text("2")
    assert [p.name for p in path.iterdir()] == ["two"]
    with pytest.raises(ZeroDivisionError), atomic_folder(path) as tmp:
        _ = 1 / 0
    assert [p.name for p in tmp_path.iterdir()] == ["pack"]


def test_another_process_may_replace_a_folder_at_the_same_time(tmp_path, monkeypatch):
    """Two commands that import the same asset share its folder in the cache."""
    path, replace, others = tmp_path / "asset", os.replace, [tmp_path / "other"]

    def replace_after_another(source, target):
        if target == path and others:
            other = others.pop()
            other.mkdir()
            (other / "theirs").touch()
            replace(other, path)
        replace(source, target)

    monkeypatch.setattr(files.os, "replace", replace_after_another)
    with atomic_folder(path) as tmp:
        (tmp / "ours").touch()
    assert [p.name for p in path.iterdir()] == ["ours"]
    assert [p.name for p in tmp_path.iterdir()] == ["asset"]


def test_leftovers_of_a_killed_run_are_removed_after_a_day(tmp_path):
    old, young, other = (tmp_path / name for name in (".pack.a.tmp", ".pack.b.tmp", ".spack.c.tmp"))
    for folder in (old, young, other):
        folder.mkdir()
    os.utime(old, (0, 0))
    os.utime(other, (0, 0))
    with atomic_folder(tmp_path / "pack"):
        pass
    assert sorted(p.name for p in tmp_path.iterdir()) == [".pack.b.tmp", ".spack.c.tmp", "pack"]


@pytest.mark.parametrize(("variable", "folder"), [("ROBOCAS_CACHE", "cache"), ("ROBOCAS_DATA", "data"), ("", "out")])
def test_the_error_of_an_unwritable_folder_names_its_environment_variable(tmp_path, monkeypatch, variable, folder):
    (tmp_path / "file").write_text("")
    for name, place in (("ROBOCAS_CACHE", "cache"), ("ROBOCAS_DATA", "data")):
        monkeypatch.setenv(name, str(tmp_path / "file" / place))
    with pytest.raises(RobocasError) as error:
        make_folder(tmp_path / "file" / folder / "robots")
    assert error.value.fix.startswith(f"Set {variable} to" if variable else "Choose another")


def test_a_full_disk_error_names_the_target_not_the_source(tmp_path):
    full = OSError(errno.ENOSPC, "No space left on device", "/site-packages/hand.stl", None, str(tmp_path / "hand.stl"))
    with (
        pytest.raises(OSError, match="No space") as error,
        add_path_to_errors(tmp_path / "outer"),
        add_path_to_errors(tmp_path / "robots"),
    ):
        raise full
    assert error.value.filename == str(tmp_path / "robots")
    with pytest.raises(OSError, match="No such file") as error, add_path_to_errors(tmp_path / "robots"):
        (tmp_path / "gone").read_text()
    assert error.value.filename == str(tmp_path / "gone")


def test_sync_flushes_files_before_the_rename(tmp_path, monkeypatch):
    done = []

    def note(owner, name, say):
        whole = getattr(owner, name)
        monkeypatch.setattr(owner, name, lambda *args: (done.append(say(*args)), whole(*args))[1])

    def path_of(descriptor):
        return Path(f"/proc/self/fd/{descriptor}").readlink().name

    note(os, "fsync", lambda descriptor: ("sync", path_of(descriptor)))
    note(os, "replace", lambda before, after: ("rename", Path(before).name))
    note(files, "flush_to_disk", lambda folder: ("sync", Path(folder).name))
    write_json(tmp_path / "a.json", {})
    write_json(tmp_path / "b.json", {}, sync=True)
    (_, temporary), *_ = done[1:]
    assert done[1:] == [("sync", temporary), ("rename", temporary), ("sync", tmp_path.name)]
    assert temporary.startswith(".b.")
    assert temporary.endswith(".tmp.json")  # the pattern of `output_folder.remove_temporary_files`
    done.clear()
    with atomic_folder(tmp_path / "folder", sync=True) as folder:
        (folder / "file").write_text("")
    assert done == [("sync", folder.name), ("rename", folder.name)]


@pytest.mark.parametrize("kind", ["link", "dangling link", "pipe"])
def test_only_a_regular_file_is_opened_for_append(tmp_path, kind):
    path, target = tmp_path / "notes", tmp_path / "target"
    if kind == "pipe":
        os.mkfifo(path)
    else:
        path.symlink_to(target)
    if kind == "link":
        target.write_text("kept")
    with pytest.raises(RobocasError) as error:
        open_for_append(path)
    assert error.value.where == path
    assert (target.read_text() if kind == "link" else target.exists()) == ("kept" if kind == "link" else False)


def test_temporary_names_are_random(tmp_path):
    """A symbolic link at a predictable name would redirect the writer to another file."""
    names = set()
    for _ in range(3):
        with atomic_file(tmp_path / "run.json") as tmp:
            tmp.write_text("{}")
            names.add(tmp.name)
    assert len(names) == 3
    (tmp_path / "target").write_text("kept")
    (tmp_path / "link.json").symlink_to(tmp_path / "target")
    write_json(tmp_path / "link.json", {})  # the name itself is replaced, not what it leads to
    assert (tmp_path / "target").read_text() == "kept"


@pytest.mark.parametrize("name", ["é" * 125 + ".json", "." + "b" * 254])
def test_the_longest_file_name_can_be_written(tmp_path, name):
    write_json(tmp_path / name, {"n": 1})
    assert [path.name for path in tmp_path.iterdir()] == [name]
    with pytest.raises(OSError, match=name[:20]):
        write_json(tmp_path / f"a{name}", {})
    assert [path.name for path in tmp_path.iterdir()] == [name]


_DEEP: list = []
for _ in range(3000):
    _DEEP = [_DEEP]
_CYCLE: dict = {}
_CYCLE["a"] = _CYCLE


@pytest.mark.parametrize(
    ("value", "key"),
    [
        ({"wants": {"rates": [1.0, float("nan")]}}, "wants.rates.1"),
        ({"a": -(2**70)}, "a"),
        ({"a": "\ud800"}, "a"),
        ({"a": {1, 2}}, "a"),
        ({"b": {float("nan"): 1}}, "b"),
        ({"a": _DEEP}, "a.0"),
        (_CYCLE, "a.a"),
    ],
)
def test_json_values_that_cannot_be_read_back_are_not_written(tmp_path, value, key):
    write_json(tmp_path / "a.json", {"n": 1})
    with pytest.raises(RobocasError) as error:
        write_json(tmp_path / "a.json", value)
    assert str(error.value.where).startswith(f"{tmp_path / 'a.json'}{', ' if key else ''}{key}")
    assert load_json(tmp_path / "a.json") == {"n": 1}
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]
