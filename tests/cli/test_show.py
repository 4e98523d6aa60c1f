from typing import get_args, get_type_hints

import pytest
from mani_skill.render.shaders import PREBUILT_SHADER_CONFIGS

from robocas_ms3.cli.main import run
from robocas_ms3.cli.show import Show


def test_wrong_arguments_leave_no_folder(tmp_path, capsys):
    out = tmp_path / "scene"
    assert run(["show", "--seed", "-5", "--out", str(out)]) == 1
    assert capsys.readouterr().err == "error: seed: this number is out of range (expected 0 to 4294967295, found -5)\n"
    with pytest.raises(SystemExit) as left:
        run(["show", "--shader", "foo", "--out", str(out)])
    assert left.value.code == 2
    assert not out.exists()


def test_shaders_are_maniskills():
    assert set(get_args(get_type_hints(Show)["shader"])) == PREBUILT_SHADER_CONFIGS.keys()


def test_ray_tracing_without_a_gpu_is_refused(tmp_path, monkeypatch, capsys):
    def none(name):
        raise RuntimeError(f'failed to find device "{name}"')

    monkeypatch.setattr("sapien.Device", none)
    assert run(["show", "--shader", "rt", "--out", str(tmp_path / "out")]) == 1
    assert "--shader rt: ray tracing needs a GPU (found none). Pass --shader default." in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
