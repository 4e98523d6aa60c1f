"""Output folders: continued, refused and overwritten folders, and leftovers."""

import errno
import json
import os
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Barrier

import pytest

from robocas_ms3.core.errors import OutputExistsError, RobocasError
from robocas_ms3.core.files import atomic_folder
from robocas_ms3.core.locks import lock_folder
from robocas_ms3.core.output_folder import FolderKind, OutputFolder, check_replaceable, is_empty, remove_temporary_files

KIND = FolderKind("robocas test", ("run.json",), "rate", markers=("old_format",))
SETTINGS = {"rate": 5, "camera": {"size": [640, 480], "depth": True}}


def write_run(path, settings=SETTINGS, *, episodes=1, overwrite=False):
    with OutputFolder(path, KIND, settings, overwrite=overwrite) as output:
        output.start(settings)
        for number in range(episodes):
            (path / f"episode_{number}").write_text("written")


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_run_with_the_recorded_settings_continues(tmp_path):
    out = tmp_path / "a" / "out"
    write_run(out)
    (out / ".episode_1.tmp").mkdir()
    with OutputFolder(out, KIND, SETTINGS) as output:
        assert output.recorded == SETTINGS
        output.start({**SETTINGS, "episodes": 2})
        assert names(out) == ["episode_0", "run.json"]  # what a killed run left half written is gone
    assert json.loads((out / "run.json").read_text()) == {**SETTINGS, "episodes": 2}
    assert names(out.parent) == ["out"]


def test_other_settings_are_refused_with_all_changes(tmp_path):
    write_run(tmp_path / "out")
    other = {"rate": 10, "camera": {"size": [640, 360]}, "codec": "h264"}
    with pytest.raises(OutputExistsError) as error:
        write_run(tmp_path / "out", other)
    assert error.value.where == tmp_path / "out" / "run.json"
    changes = ["rate: 5 -> 10", "camera.size.1: 480 -> 360", "camera.depth: true -> null", 'codec: null -> "h264"']
    assert error.value.found.split("; ") == changes
    with OutputFolder(tmp_path / "out", KIND) as output, pytest.raises(OutputExistsError):
        output.check_settings(other)
    write_run(tmp_path / "out", other, episodes=2, overwrite=True)
    assert names(tmp_path / "out") == ["episode_0", "episode_1", "run.json"]


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("record", [None, "[]", "{", '{"protocol": "of another command"}'])
def test_folder_of_another_program_is_not_changed(tmp_path, record, overwrite):
    (tmp_path / "thesis").touch()
    if record is not None:
        (tmp_path / "run.json").write_text(record)
    before = names(tmp_path)
    for path in (tmp_path, tmp_path / "thesis"):
        with pytest.raises(OutputExistsError) as error:
            write_run(path, overwrite=overwrite)
        assert error.value.where == path
    assert names(tmp_path) == before


def test_known_folder_without_settings_can_only_be_overwritten(tmp_path):
    (tmp_path / "old_format").write_text("some")
    with pytest.raises(OutputExistsError):
        write_run(tmp_path)
    write_run(tmp_path, overwrite=True)
    assert names(tmp_path) == ["episode_0", "run.json"]


@pytest.mark.parametrize("episodes", [0, 1])
def test_run_that_fails_keeps_a_folder_with_results_only(tmp_path, episodes):
    with pytest.raises(KeyboardInterrupt), OutputFolder(tmp_path / "a" / "out", KIND, SETTINGS) as output:
        output.start(SETTINGS)
        (output.path / "empty").mkdir()
        for number in range(episodes):
            (output.path / f"episode_{number}").write_text("written")
        raise KeyboardInterrupt
    assert (tmp_path / "a").exists() is bool(episodes)


def test_folder_without_results_is_started_with_any_settings(tmp_path):
    write_run(tmp_path, episodes=0)  # as if killed there
    (tmp_path / "parts").mkdir()
    write_run(tmp_path, {"rate": 10})


def test_overwritten_folder_stays_until_the_start(tmp_path):
    write_run(tmp_path / "out")
    with pytest.raises(ZeroDivisionError), OutputFolder(tmp_path / "out", KIND, SETTINGS, overwrite=True):
        _ = 1 / 0
    assert names(tmp_path / "out") == ["episode_0", "run.json"]


@pytest.mark.parametrize("record", ["run.json", "meta/run.json"])
@pytest.mark.parametrize("moves", range(4))
def test_run_killed_while_it_overwrites_is_started_again(tmp_path, monkeypatch, record, moves):
    kind, out, replace, left = FolderKind("robocas test", (record,), "rate"), tmp_path / "out", os.replace, [moves]
    with OutputFolder(out, kind, SETTINGS) as output:
        output.start(SETTINGS)
        for name in ("episode_0", "summary.json", "videos"):
            (out / name).write_text("old")

    def replace_some(source, target):
        if Path(target).parent.name.endswith(".old"):
            left[0] -= 1
            if left[0] < 0:
                raise KeyboardInterrupt
        replace(source, target)

    with monkeypatch.context() as patch, OutputFolder(out, kind, SETTINGS, overwrite=True) as output:
        patch.setattr(os, "replace", replace_some)
        with pytest.raises(KeyboardInterrupt):
            output.start(SETTINGS)
    with OutputFolder(out, kind, {"rate": 10}) as output:
        assert output.recorded is None
        output.start({"rate": 10})
        assert names(out) == [record.split("/")[0]]


def test_link_to_an_overwritten_folder_stays(tmp_path):
    write_run(tmp_path / "disk" / "data")
    (tmp_path / "out").symlink_to(tmp_path / "disk" / "data")
    write_run(tmp_path / "out", episodes=0, overwrite=True)
    assert (tmp_path / "out").is_symlink()
    assert names(tmp_path / "disk") == ["data"]
    assert names(tmp_path / "disk" / "data") == ["run.json"]


def test_folder_removed_during_the_run(tmp_path):
    with pytest.raises(FileNotFoundError), OutputFolder(tmp_path / "out", KIND, SETTINGS) as output:
        output.start(SETTINGS)
        (output.path / "none").read_text()  # another missing file is a mistake in the code
    with pytest.raises(RobocasError) as error, OutputFolder(tmp_path / "out", KIND, SETTINGS) as output:
        output.start(SETTINGS)
        output.check_exists()
        (output.path / "run.json").unlink()
        with pytest.raises(RobocasError):
            output.check_exists()
        (output.path / "run.json").read_text()
    assert error.value.where == tmp_path / "out"


def test_two_runs_in_one_folder(tmp_path):
    with OutputFolder(tmp_path / "out", KIND, SETTINGS), pytest.raises(RobocasError):
        write_run(tmp_path / "out")


def test_shared_folder_is_not_locked_and_keeps_its_record_and_leftovers(tmp_path):
    out = tmp_path / "out"
    with OutputFolder(out, KIND, SETTINGS, shared=True) as first:
        first.start({**SETTINGS, "started": 1})
        (out / ".run.1.tmp.json").touch()  # of another process that starts
        with pytest.raises(ZeroDivisionError), OutputFolder(out, KIND, SETTINGS, shared=True) as second:
            second.start({**SETTINGS, "started": 2})
            _ = 1 / 0
        assert json.loads((out / "run.json").read_text())["started"] == 1
        assert names(out) == [".run.1.tmp.json", "run.json"]
        with pytest.raises(OutputExistsError), OutputFolder(out, KIND, {"rate": 10}, shared=True):
            pass
        first.check_record()
        (out / "run.json").write_text('{"rate": 10}')  # of a run that overwrites
        with pytest.raises(OutputExistsError):
            first.check_record()
        (out / "run.json").unlink()
        with pytest.raises(RobocasError):
            first.check_record()


def test_output_written_at_once_is_replaced_only_with_overwrite(tmp_path):
    out = tmp_path / "out"
    check_replaceable(out)
    out.mkdir()
    check_replaceable(out)
    (out / "index.js").touch()
    for overwrite in (None, False):
        with pytest.raises(OutputExistsError):
            check_replaceable(out, overwrite=overwrite)
    check_replaceable(out, overwrite=True, markers=("index.html", "index.js"))
    with pytest.raises(OutputExistsError):
        check_replaceable(out, overwrite=True, markers=("pack.json",))


def test_leftovers_are_removed_and_links_are_not_followed(tmp_path):
    for name in (".a.1.tmp.png", ".b.tmp", "kept.tmp", ".c.old"):
        (tmp_path / name).mkdir() if name == ".b.tmp" else (tmp_path / name).touch()
    (tmp_path / "disk").mkdir()
    (tmp_path / "disk" / "file").touch()
    (tmp_path / ".link.tmp").symlink_to(tmp_path / "disk")
    remove_temporary_files(tmp_path)
    assert names(tmp_path) == ["disk", "kept.tmp"]
    assert (tmp_path / "disk" / "file").exists()


@pytest.fixture
def mounted(tmp_path, monkeypatch):
    """A writable folder that cannot be renamed and has a read-only parent, such as a mount in a container."""
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


def test_mounted_folder_is_locked_and_emptied_in_place(mounted):
    write_run(mounted)
    with lock_folder(mounted), pytest.raises(RobocasError):
        write_run(mounted)
    write_run(mounted, episodes=0, overwrite=True)
    assert names(mounted) == ["run.json"]


def test_mounted_folder_is_replaced_by_moving_entries(mounted):
    (mounted / "old").touch()
    with pytest.raises(ZeroDivisionError), atomic_folder(mounted) as folder:
        (folder / "new").touch()
        _ = 1 / 0
    assert names(mounted) == ["old"]
    with atomic_folder(mounted) as folder:
        (folder / "new").mkdir()
    assert names(mounted) == ["new"]


def test_folder_that_another_process_creates_during_the_check_is_empty(tmp_path):
    """Shards of a plan start together; one of them was refused, as the check asked twice whether the folder exists."""
    barrier, interval = Barrier(2), sys.getswitchinterval()

    def create(path):
        barrier.wait()
        path.mkdir()

    def check(path):
        barrier.wait()
        return is_empty(path)

    sys.setswitchinterval(1e-6)  # the check failed for about 30 of 3000 folders
    try:
        with ThreadPoolExecutor(2) as threads:
            for number in range(3000):
                path = tmp_path / str(number)
                created, empty = threads.submit(create, path), threads.submit(check, path)
                created.result()
                assert empty.result()
    finally:
        sys.setswitchinterval(interval)
