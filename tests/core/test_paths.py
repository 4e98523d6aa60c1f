import json
import logging
import os
import pwd
import subprocess
import sys
import tempfile

import pytest

from robocas_ms3.core import paths
from robocas_ms3.core.errors import RobocasError


@pytest.fixture
def home(tmp_path, monkeypatch):
    """A user whose only writable folder is the temporary directory."""
    (tmp_path / "home").write_text("")
    (tmp_path / "temporary").mkdir()
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    for name in ("ROBOCAS_CACHE", "ROBOCAS_DATA", "XDG_CACHE_HOME", "XDG_CONFIG_HOME"):
        monkeypatch.delenv(name, raising=False)
    paths._choose_cache.cache_clear()
    yield tmp_path / "home"
    paths._choose_cache.cache_clear()


def test_a_home_that_is_read_only_gives_a_private_cache_and_one_warning(home, caplog):
    with caplog.at_level(logging.WARNING):
        cache = paths.cache_dir()
        assert paths.cache_dir() == cache == home.with_name("temporary") / f"robocas-{os.getuid()}"
    assert cache.stat().st_mode & 0o777 == 0o700
    assert paths.find_path_variable(cache / "robots" / "x") == "ROBOCAS_CACHE"
    (said,) = caplog.messages
    assert str(home) in said
    assert "ROBOCAS_CACHE" in said


@pytest.mark.parametrize("fake", ["others can write", "a link"])
def test_a_cache_folder_of_another_user_is_not_used(home, fake):
    folder = home.with_name("temporary") / f"robocas-{os.getuid()}"
    if fake == "a link":
        home.with_name("elsewhere").mkdir(mode=0o700)
        folder.symlink_to(home.with_name("elsewhere"))
    else:
        folder.mkdir()
        folder.chmod(0o777)
    assert paths.cache_dir() == home / ".cache" / "robocas"  # where the error then says what to do


def test_cache_dir_does_not_create_the_folder(home):
    home.unlink()
    assert paths.cache_dir() == home / ".cache" / "robocas"
    assert not home.exists()
    assert not any(home.with_name("temporary").iterdir())


@pytest.fixture
def no_home(monkeypatch, tmp_path):
    """A user id without an entry in the system's list of users, as in many containers, and without variables."""

    def unknown(uid):
        raise KeyError(uid)

    monkeypatch.setattr(pwd, "getpwuid", unknown)
    for name in ("ROBOCAS_CACHE", "ROBOCAS_DATA", "XDG_CACHE_HOME", "XDG_DATA_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", "")  # so that what is set is undone
    monkeypatch.delenv("HOME")


@pytest.mark.parametrize("home", [None, "", "relative"])
def test_without_a_home_folder_both_variables_are_needed(no_home, monkeypatch, tmp_path, home):
    if home is not None:
        monkeypatch.setenv("HOME", home)
    for needed in (paths.data_dir, paths.cache_dir, paths.ensure_home):
        with pytest.raises(RobocasError) as error:
            needed()
        assert error.value.where == "HOME"
    assert paths.find_path_variable(tmp_path) == ""
    monkeypatch.setenv("ROBOCAS_DATA", str(tmp_path / "data"))
    assert paths.data_dir() == tmp_path / "data"
    with pytest.raises(RobocasError):
        paths.ensure_home()
    monkeypatch.setenv("ROBOCAS_CACHE", str(tmp_path / "cache"))
    paths.ensure_home()
    assert os.environ["HOME"] == str(tmp_path / "cache" / "home")
    assert paths.find_path_variable(tmp_path / "data" / "packs") == "ROBOCAS_DATA"
    assert not any(tmp_path.iterdir())


def test_an_empty_home_variable_is_set_to_the_users_home_folder(monkeypatch):
    monkeypatch.setenv("HOME", "")
    paths.ensure_home()
    assert os.environ["HOME"] == pwd.getpwuid(os.getuid()).pw_dir


_COMMAND = """
import os, pwd, sys
def unknown(uid): raise KeyError(uid)
pwd.getpwuid = unknown  # before anything is imported
from robocas_ms3.cli.main import main
main(sys.argv[1:])
"""


@pytest.mark.parametrize("chosen", [False, True])
def test_a_command_without_a_home_folder(tmp_path, chosen):
    kept = {key: value for key, value in os.environ.items() if not key.startswith(("HOME", "XDG_", "ROBOCAS_"))}
    folders = {"ROBOCAS_CACHE": str(tmp_path / "cache"), "ROBOCAS_DATA": str(tmp_path / "data")} if chosen else {}
    command = [sys.executable, "-c", _COMMAND, "list", "--json"]
    done = subprocess.run(command, env=kept | folders, capture_output=True, text=True, check=False)
    assert done.returncode == (0 if chosen else 1)
    if chosen:
        assert [pack["name"] for pack in json.loads(done.stdout)["packs"]] == ["builtin"]
    else:
        (line,) = done.stderr.splitlines()
        assert line.startswith("error: HOME: ")
