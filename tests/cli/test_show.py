from typing import get_args, get_type_hints

from mani_skill.render.shaders import PREBUILT_SHADER_CONFIGS

from robocas_ms3.cli.main import run
from robocas_ms3.cli.show import Show


def test_shaders_exist_in_maniskill():
    assert set(get_args(get_type_hints(Show)["shader"])) == PREBUILT_SHADER_CONFIGS.keys()


def test_ray_tracing_without_a_gpu_is_an_error(tmp_path, monkeypatch, capsys):
    def none(name):
        raise RuntimeError(f'failed to find device "{name}"')

    monkeypatch.setattr("sapien.Device", none)
    assert run(["show", "--shader", "rt", "--out", str(tmp_path / "out")]) == 2
    assert (
        "--shader rt: ray tracing needs a GPU (found no CUDA device). Pass --shader default." in capsys.readouterr().err
    )
    assert not (tmp_path / "out").exists()
