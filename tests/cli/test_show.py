from typing import get_args, get_type_hints

import pytest
from mani_skill.render.shaders import PREBUILT_SHADER_CONFIGS

from robocas_ms3.cli.main import run
from robocas_ms3.cli.show import Show


def test_wrong_arguments_leave_no_folder(tmp_path, capsys):
    out = tmp_path / "scene"
    assert run(["show", "--seed", "-5", "--out", str(out)]) == 1
    assert capsys.readouterr().err == "error: seed: this number is out of range (expected 0 to 4294967295, found -5)\n"
    with pytest.raises(SystemExit) as exit_info:
        run(["show", "--shader", "foo", "--out", str(out)])
    assert exit_info.value.code == 2
    assert "Expected one of" in capsys.readouterr().err
    assert not out.exists()


def test_shaders_are_maniskills():
    assert set(get_args(get_type_hints(Show)["shader"])) == PREBUILT_SHADER_CONFIGS.keys()
