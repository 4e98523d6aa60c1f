"""Joined files are checked before their sources are deleted; damaged files are joined again."""

import os
import shutil

import h5py
import pytest
from plan_stages import PLAN, assert_same, run_here

from robocas_ms3.core.errors import PlanError
from robocas_ms3.plans.folder import PlanFolder, WorkUnit


@pytest.mark.parametrize(
    "name",
    ["demos/a/trajectory.h5", "datasets/robocas/conversion.json", "datasets/robocas/data_info.json", "report.json"],
)
def test_empty_file_is_joined_again(undisturbed, out, name):
    (out / name).parent.mkdir(parents=True, exist_ok=True)
    (out / name).write_bytes(b"")
    run_here(out)
    assert_same(undisturbed, out)
    assert not list((out / "units").rglob("*.h5"))


@pytest.mark.parametrize(
    "name",
    ["demos/a/trajectory.h5", "demos/a/trajectory.json", "datasets/robocas/conversion.json"],
)
def test_truncated_file_is_joined_again(undisturbed, out, monkeypatch, name):
    with monkeypatch.context() as patch, pytest.raises(ZeroDivisionError):
        patch.setattr("robocas_ms3.plans.join._make_report", lambda *_: {"x": 1})
        patch.setattr("robocas_ms3.plans.join.flush_to_disk", lambda path: (out / "demos").exists() and 1 / 0)
        run_here(out)
    os.truncate(out / name, (out / name).stat().st_size // 2)
    run_here(out)
    assert_same(undisturbed, out)


def test_damaged_report_is_written_again(undisturbed, tmp_path):
    out = shutil.copytree(undisturbed, tmp_path / "out")
    (out / "report.json").write_bytes(b"")
    assert run_here(out)["episodes"] == 7
    assert_same(undisturbed, out)


def test_damaged_file_without_sources_is_an_error(undisturbed, tmp_path):
    out = shutil.copytree(undisturbed, tmp_path / "out")
    (out / "report.json").unlink()
    os.truncate(out / "demos/b/trajectory.h5", 2000)
    with pytest.raises(PlanError, match=r"demos/b/trajectory.h5: .*0000000003/recording.h5 is missing"):
        run_here(out)


def test_sources_are_kept_if_the_joined_file_is_damaged(out, monkeypatch):
    def merge_without_last(shards, path):
        with h5py.File(path, "w"):
            shutil.copy(shards[0].with_suffix(".json"), path.with_suffix(".json"))

    before = {path for path in (out / "units").rglob("*.h5")}
    monkeypatch.setattr("robocas_ms3.plans.join.merge", merge_without_last)
    with pytest.raises(PlanError, match="demos/a/trajectory.h5: .*damaged after writing .found wrong episodes"):
        run_here(out)
    assert before == {path for path in (out / "units").rglob("*.h5")}
    assert not (out / "report.json").exists()


def test_remaining_sources_are_kept_if_demonstrations_are_damaged(undisturbed, tmp_path, monkeypatch):
    out = shutil.copytree(undisturbed, tmp_path / "out")
    left = PlanFolder(PLAN, out).seed_files(WorkUnit(0, 0), 10).recording_path
    left.parent.mkdir()
    left.write_bytes(b"left")
    os.truncate(out / "demos/a/trajectory.h5", 0)
    with pytest.raises(PlanError, match="its source files are missing"):
        run_here(out)
    assert left.exists()


def test_joined_files_are_flushed_before_they_are_renamed(out, monkeypatch):
    synced, named = set(), []
    sync, replace = os.fsync, os.replace
    monkeypatch.setattr("os.fsync", lambda fd: (synced.add(os.fstat(fd).st_ino), sync(fd)))

    def note(old, new):
        if os.path.isfile(old) and os.stat(old).st_ino in synced:
            named.append(os.path.basename(new))
        replace(old, new)

    monkeypatch.setattr("os.replace", note)
    run_here(out)
    assert set(named) >= {"trajectory.h5", "trajectory.json", "conversion.json", "scene.json", "report.json"}


def test_second_run_joins_nothing(undisturbed, tmp_path):
    out = shutil.copytree(undisturbed, tmp_path / "out")
    said = []
    run_here(out, on_stage=said.append)
    assert said == []
