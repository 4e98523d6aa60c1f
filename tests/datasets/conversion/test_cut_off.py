"""Truncated files: the next run writes their episode again, robocas validate reports them."""

import shutil

import pytest
from managing import convert_made_up as run
from managing import files_of
from synthetic import RayCaster

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets.checks.dataset import validate
from robocas_ms3.datasets.conversion.episode_folder import find_damaged_file
from robocas_ms3.datasets.conversion.settings import ConversionSettings
from robocas_ms3.datasets.images.image_files import ImageOptions
from robocas_ms3.robots.cameras import STANDARD_CAMERA_NAMES

FILES = (
    "episode_info.npz",
    "scene.json",
    "base_camera/rgb/0003.png",
    "gripper_camera/depth/0006.png",
    "static_camera/intrinsic.npy",
    "base_camera/cam_pose_wrt_arm_base.npy",
)


def harm(path, left):
    """Truncate a file, or remove it."""
    if left is None:
        path.unlink()
    else:
        path.write_bytes(path.read_bytes()[: int(left * path.stat().st_size)])


@pytest.fixture(scope="module")
def whole(trajectory, tmp_path_factory):
    out = tmp_path_factory.mktemp("whole") / "out"
    run(trajectory, out)
    return out


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("left", [0.97, None])
def test_each_truncated_file_is_found(whole, tmp_path, name, left):
    out = shutil.copytree(whole, tmp_path / "out")
    harm(out / "episode_0000001" / name, left)
    image_options = ImageOptions(STANDARD_CAMERA_NAMES)
    assert find_damaged_file(out / "episode_0000000", image_options) is None
    assert find_damaged_file(out / "episode_0000001", image_options) == out / "episode_0000001" / name
    assert any(name.rpartition("/")[2] in str(violation) for violation in validate(out).violations)


def test_episode_with_a_truncated_file_is_written_again(whole, trajectory, tmp_path, caplog):
    out = shutil.copytree(whole, tmp_path / "out")
    path = out / "episode_0000001" / FILES[2]
    harm(path, 0.97)
    done = run(trajectory, out)
    assert (done.existing, [episode.number for episode in done.episodes]) == (1, [1])
    assert f"{path} is missing or truncated" in caplog.text
    assert files_of(out) == files_of(whole)


@pytest.mark.parametrize("image_format", ["png", "jpg", "webp"])
def test_images_of_each_format(trajectory, tmp_path, image_format):
    image_options = ImageOptions(("base_camera",), image_format=image_format, depth=False)
    run(trajectory, tmp_path / "out", cameras=("base_camera",), image_format=image_format, depth=False)
    folder = tmp_path / "out" / "episode_0000000"
    assert find_damaged_file(folder, image_options) is None
    for left in (0.9, 0):
        path = folder / "base_camera" / "rgb" / f"0002.{image_format}"
        harm(path, left)
        assert find_damaged_file(folder, image_options) == path


def test_truncated_split_is_made_again_after_deleting_it(whole, trajectory, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(whole, out)
    harm(out / "data_info.json", 0.5)
    with pytest.raises(DatasetError, match="data_info.json: the split can't be read.*Delete the file"):
        run(trajectory, out)
    (out / "data_info.json").unlink()
    run(trajectory, out)
    assert files_of(out) == files_of(whole)


@pytest.mark.parametrize("name", ["episode.json", "frames.parquet", "rgb_base_camera.mp4"])
def test_temporary_episode_folders_of_a_lerobot_conversion(trajectory, tmp_path, monkeypatch, name):
    pytest.importorskip("av", reason="needs the extra 'lerobot'")
    pytest.importorskip("pyarrow", reason="needs the extra 'lerobot'")
    from robocas_ms3.datasets.lerobot import convert as lerobot

    def killed(*args):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(lerobot, "_join_dataset", killed)
        lerobot.convert_lerobot(ConversionSettings(trajectory, tmp_path / "out", open_renderer=RayCaster))
    harm(tmp_path / "out" / ".episodes" / "episode_0000001" / name, 0.5)
    done = lerobot.convert_lerobot(ConversionSettings(trajectory, tmp_path / "out", open_renderer=RayCaster))
    assert (done.existing, [episode.number for episode in done.episodes]) == (1, [1])
    lerobot.convert_lerobot(ConversionSettings(trajectory, tmp_path / "whole", open_renderer=RayCaster))
    assert files_of(tmp_path / "out") == files_of(tmp_path / "whole")
