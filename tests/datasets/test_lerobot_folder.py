"""RoboCAS folders as a source of LeRobot datasets."""

import cv2
import pytest
from synthetic import RayCaster, write_trajectory

pytest.importorskip("av", reason="needs the extra 'lerobot'")
pytest.importorskip("pyarrow", reason="needs the extra 'lerobot'")

from robocas_ms3.datasets.convert import convert
from robocas_ms3.datasets.lerobot.convert import convert_lerobot
from robocas_ms3.datasets.pictures import Pictures
from robocas_ms3.errors import DatasetError


def shrink(path, size):
    cv2.imwrite(str(path), cv2.resize(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), size))


@pytest.mark.parametrize(
    ("episode", "camera", "kind", "step"),
    [(0, "base_camera", "rgb", 1), (0, "base_camera", "depth", 0), (1, "gripper_camera", "rgb", 0),
     (1, "static_camera", "depth", 6), (1, "static_camera", "rgb", 6)],
)  # fmt: skip
@pytest.mark.parametrize("size", [(32, 24), (48, 64)])
def test_a_picture_of_another_size(dataset, tmp_path, episode, camera, kind, step, size):
    """An encoder would scale it without a word."""
    folder = dataset / f"episode_{episode:07d}"
    shrink(folder / camera / kind / f"{step:04d}.png", size)
    with pytest.raises(DatasetError) as caught:
        convert_lerobot(dataset, tmp_path / "out")
    said = f"{folder}, {camera}/{kind}, step {step}: this picture is not of the dataset's size"
    assert str(caught.value).startswith(f"{said} (expected 64 x 48, found {size[0]} x {size[1]}). ")
    assert (tmp_path / "out").exists() == bool(episode)  # to go on with, where an episode was done


def test_what_is_not_taken_is_not_looked_at(dataset, tmp_path):
    folder = dataset / "episode_0000001"
    shrink(folder / "static_camera" / "rgb" / "0003.png", (32, 24))
    shrink(folder / "base_camera" / "depth" / "0003.png", (32, 24))
    done = convert_lerobot(dataset, tmp_path / "out", pictures=Pictures(("base_camera",), depth=False))
    assert len(done.episodes) == 2


def test_cameras_may_differ(tmp_path):
    """Our own don't; a camera's own size is what its pictures have to have."""
    trajectory = write_trajectory(tmp_path / "F.h5", seeds=(1, 2))
    convert(trajectory, tmp_path / "ds", embeddings=False, open_source=RayCaster)
    for path in (tmp_path / "ds").glob("episode_*/gripper_camera/*/*.png"):
        shrink(path, (32, 24))
    assert len(convert_lerobot(tmp_path / "ds", tmp_path / "out").episodes) == 2
