import os
import subprocess
import sys
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


def test_without_a_vulkan_driver_the_error_is_one_line(tmp_path):
    env = {**os.environ, "VK_ICD_FILENAMES": "/nonexistent", "VK_DRIVER_FILES": "/nonexistent"}
    program = f"from robocas_ms3.cli.main import main; main(['show', '--out', {str(tmp_path / 'out')!r}])"
    done = subprocess.run([sys.executable, "-c", program], env=env, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr.count("\n"), "Traceback" in done.stderr) == (1, 1, False), done.stderr
    assert not (tmp_path / "out").exists()
