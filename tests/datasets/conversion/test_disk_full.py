"""A disk that is full at any file: one line says so, no episode is half there, the input stays, and resuming works.

Files that Python writes are cut off by half, with the error that a full disk gives. What FFmpeg and Arrow write goes to
/dev/full, so that the error is the system's own.
"""

import errno
import os
import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from managing import files_of
from synthetic import RayCaster, render_by

from robocas_ms3.cli.main import run
from robocas_ms3.datasets.checks.dataset import validate
from robocas_ms3.datasets.conversion import convert as conversion


def half(write, path, data, **_):
    write(path, data[: len(data) // 2])
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))


def no_archive(path, **_):
    half(Path.write_bytes, path, b"PK\x03\x04")


def to_dev_full(function, path_at):
    """Call with a path that leads to the full device."""

    def filled(*args, **kwargs):
        Path(args[path_at]).symlink_to("/dev/full")
        return function(*args, **kwargs)

    return filled


def named_dev_full(function):
    """Give a path that leads to the full device."""

    def filled(*args, **kwargs):
        path = function(*args, **kwargs)
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.exists():
            path.symlink_to("/dev/full")
        return path

    return filled


def fills_up(monkeypatch, owner, name, last, instead):
    """Replace a function from its n-th call on."""
    whole, calls = getattr(owner, name), []

    def counted(*args, **kwargs):
        calls.append(name)
        return (instead if len(calls) >= last else whole)(*args, **kwargs)

    monkeypatch.setattr(owner, name, counted)


def ends_in_one_line(command, capsys):
    assert run(command) == 1
    said = capsys.readouterr().err.splitlines(keepends=True)
    error = "".join(line for line in said if not line.startswith("episodes written: "))
    assert error.startswith("error: ")
    assert ": No space left on device (" in error
    assert "Free disk space" in error
    assert error.count("\n") == 1


@pytest.fixture
def stub_images(monkeypatch):
    monkeypatch.setattr(conversion, "convert", render_by(RayCaster, conversion.convert))


PYTHON = {
    "write_bytes": (Path, "write_bytes", partial(half, Path.write_bytes)),
    "write_text": (Path, "write_text", partial(half, Path.write_text)),
    "savez": (np, "savez", no_archive),
}


@pytest.mark.parametrize(
    ("name", "last", "episodes"),
    [
        ("write_bytes", 1, 0),  # the first image
        ("write_bytes", 60, 1),  # one of the second episode; the first has 42
        ("savez", 2, 1),
        ("write_text", 3, 1),  # scene.json of the second episode
        ("write_text", 4, 2),  # data_info.json
    ],
)
def test_a_conversion(trajectory, stub_images, tmp_path, monkeypatch, capsys, name, last, episodes):
    out, source = tmp_path / "out", files_of(trajectory.parent)
    command = ["convert", str(trajectory), "--out", str(out), "--no-embeddings", "--no-video"]
    with monkeypatch.context() as patch:
        fills_up(patch, *PYTHON[name][:2], last, PYTHON[name][2])
        ends_in_one_line(command, capsys)
    left = sorted(path.name for path in out.iterdir()) if out.exists() else []
    assert left == (["conversion.json", *(f"episode_{n:07d}" for n in range(episodes))] if episodes else [])
    assert [path.name for path in tmp_path.iterdir()] == (["out"] if episodes else [])
    assert files_of(trajectory.parent) == source
    assert run(command) == 0
    assert validate(out).violations == []
    command[3] = str(tmp_path / "whole")
    assert run(command) == 0
    assert files_of(out) == files_of(tmp_path / "whole")


@pytest.mark.parametrize(("last", "episodes"), [(1, 0), (60, 1)])
def test_a_merge(made, tmp_path, monkeypatch, capsys, last, episodes):
    out, source, shown = tmp_path / "out", files_of(made), ["conversion.json", "episode_0000000"]
    command = ["merge", str(made), "--copy", "--out", str(out)]
    with monkeypatch.context() as patch:
        fills_up(patch, shutil, "copyfile", last, lambda source, path: half(Path.write_bytes, path, b"some bytes"))
        ends_in_one_line(command, capsys)
    assert (sorted(path.name for path in out.iterdir()) if out.exists() else []) == (shown if episodes else [])
    assert files_of(made) == source
    assert run(command) == 0
    command[-1] = str(tmp_path / "whole")
    assert run(command) == 0
    assert files_of(out) == files_of(tmp_path / "whole")


@pytest.mark.parametrize(
    ("moment", "last", "parts"),
    [
        ("video", 8, 1),  # of the second; the first has 6
        ("frames", 2, 1),
        ("episode", 3, 1),  # episode.json of the second, after the plan and that of the first
        ("joined", 1, 2),  # the table of all frames
        ("joined", 7, 2),  # the last
        ("joined", 8, 2),  # the table of episodes
        ("overview", 4, 2),  # one of the JSON files about all episodes
    ],
)
def test_a_conversion_to_lerobot(made, tmp_path, monkeypatch, capsys, moment, last, parts):
    pytest.importorskip("av", reason="needs the extra 'lerobot'")
    pytest.importorskip("pyarrow", reason="needs the extra 'lerobot'")
    from robocas_ms3.datasets.lerobot import temporary_episode as written
    from robocas_ms3.datasets.lerobot.variants import FileLayout

    out, source = tmp_path / "out", files_of(made)
    command = ["convert", str(made), "--to", "lerobot", "--out", str(out)]
    text = PYTHON["write_text"]
    places = {
        "video": (written, "VideoEncoder", to_dev_full(written.VideoEncoder, 0)),
        "frames": (written.pq, "write_table", to_dev_full(written.pq.write_table, 1)),
        "episode": text,
        "joined": (FileLayout, "file_path", named_dev_full(FileLayout.file_path)),
        "overview": text,
    }
    with monkeypatch.context() as patch:
        owner, name, instead = places[moment]
        fills_up(patch, owner, name, last, instead)
        ends_in_one_line(command, capsys)
    left = sorted(path.name for path in (out / ".episodes").iterdir()) if out.exists() else []
    assert left == ([*(f"episode_{n:07d}" for n in range(parts)), "plan.json"] if parts else [])
    assert not (out / "meta").exists()
    assert files_of(made) == source
    assert run(command) == 0
    command[5] = str(tmp_path / "whole")
    assert run(command) == 0
    assert files_of(out) == files_of(tmp_path / "whole")
