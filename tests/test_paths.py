import logging
import os
import tempfile

import pytest

from robocas_ms3 import paths


@pytest.fixture
def home(tmp_path, monkeypatch):
    """A user without a folder to write to but the temporary one."""
    (tmp_path / "home").write_text("")
    (tmp_path / "temporary").mkdir()
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    for name in ("ROBOCAS_CACHE", "ROBOCAS_DATA", "XDG_CACHE_HOME", "XDG_CONFIG_HOME"):
        monkeypatch.delenv(name, raising=False)
    paths._cache_of_user.cache_clear()
    yield tmp_path / "home"
    paths._cache_of_user.cache_clear()


def test_a_home_that_is_read_only_gives_a_private_cache_and_one_warning(home, caplog):
    with caplog.at_level(logging.WARNING):
        cache = paths.cache_dir()
        assert paths.cache_dir() == cache == home.with_name("temporary") / f"robocas-{os.getuid()}"
    assert cache.stat().st_mode & 0o777 == 0o700
    assert paths.variable_of(cache / "robots" / "x") == "ROBOCAS_CACHE"
    (said,) = caplog.messages
    assert str(home) in said
    assert "ROBOCAS_CACHE" in said


@pytest.mark.parametrize("fake", ["others can write", "a link"])
def test_a_cache_that_somebody_else_laid_out_is_not_taken(home, fake):
    folder = home.with_name("temporary") / f"robocas-{os.getuid()}"
    if fake == "a link":
        home.with_name("elsewhere").mkdir(mode=0o700)
        folder.symlink_to(home.with_name("elsewhere"))
    else:
        folder.mkdir()
        folder.chmod(0o777)
    assert paths.cache_dir() == home / ".cache" / "robocas"  # where the error then says what to do


def test_a_cache_that_can_be_made_is_not_made_by_asking(home):
    home.unlink()
    assert paths.cache_dir() == home / ".cache" / "robocas"
    assert not home.exists()
    assert not any(home.with_name("temporary").iterdir())
