"""Paths of options become absolute at the start of a command, because libraries may change the working directory."""

import os
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from robocas_ms3.cli.options import with_absolute_paths
from robocas_ms3.core.errors import RobocasError
from robocas_ms3.core.paths import CACHE, DATA


@dataclass
class Inner:
    out: Path = Path("b")


@dataclass
class Outer:
    out: Path | None = None
    inputs: tuple[Path, ...] = (Path("a"), Path("/c"))
    command: Inner = field(default_factory=Inner)
    name: str = "a"


def test_all_paths_of_a_command_are_absolute(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(CACHE, "cache")
    monkeypatch.delenv(DATA, raising=False)
    made = with_absolute_paths(Outer())
    assert made == Outer(None, (tmp_path / "a", Path("/c")), Inner(tmp_path / "b"))
    assert (os.environ[CACHE], DATA in os.environ) == (str(tmp_path / "cache"), False)


def test_deleted_working_directory_is_an_error(tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    (tmp_path / "here").rmdir()
    for variable in (CACHE, DATA):
        monkeypatch.delenv(variable, raising=False)
    for cfg in (Inner(), Inner(Path("/b"))):
        with pytest.raises(RobocasError):
            with_absolute_paths(cfg)
