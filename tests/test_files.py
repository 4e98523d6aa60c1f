import os

import pytest

from robocas_ms3.errors import RobocasError
from robocas_ms3.files import make_folder, replacing, replacing_folder, write_json


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
