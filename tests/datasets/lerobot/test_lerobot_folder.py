"""RoboCAS folders as a source of LeRobot datasets."""

import shutil

import cv2
import numpy as np
import pytest
from managing import arrays_of, change, edit, make
from synthetic import RayCaster, write_trajectory

pytest.importorskip("av", reason="needs the extra 'lerobot'")
pytest.importorskip("pyarrow", reason="needs the extra 'lerobot'")

from robocas_ms3.core.errors import DatasetError, IncompleteError
from robocas_ms3.datasets.lerobot.convert import convert_lerobot
from robocas_ms3.datasets.lerobot.reader import LeRobotDataset
from robocas_ms3.datasets.manage.splitting import Share, resplit
from robocas_ms3.datasets.sources.reader import Dataset
from robocas_ms3.datasets.sources.split import split_by_seed
from robocas_ms3.datasets.writing.convert import convert
from robocas_ms3.datasets.writing.settings import ConversionSettings
from robocas_ms3.viewer.source import open_source


def shrink(path, size):
    cv2.imwrite(str(path), cv2.resize(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), size))


@pytest.mark.parametrize(
    ("episode", "camera", "kind", "step"),
    [(0, "base_camera", "rgb", 1), (1, "gripper_camera", "rgb", 0), (1, "static_camera", "depth", 6)],
)
def test_a_picture_of_another_size(dataset, tmp_path, episode, camera, kind, step):
    """An encoder would scale it without a word."""
    folder, size = dataset / f"episode_{episode:07d}", (48, 64)
    shrink(folder / camera / kind / f"{step:04d}.png", size)
    with pytest.raises(IncompleteError) as caught:
        convert_lerobot(ConversionSettings(dataset, tmp_path / "out"))
    assert list(caught.value.reasons) == [folder.name]
    assert caught.value.reasons[folder.name].startswith(f"{folder}, {camera}/{kind}, step {step}: ")
    assert f"expected 64 x 48, found {size[0]} x {size[1]}" in caught.value.reasons[folder.name]
    assert (tmp_path / "out").exists()  # to go on with, as the other episode was done


def test_what_is_not_taken_is_not_looked_at(dataset, tmp_path):
    folder = dataset / "episode_0000001"
    shrink(folder / "static_camera" / "rgb" / "0003.png", (32, 24))
    shrink(folder / "base_camera" / "depth" / "0003.png", (32, 24))
    done = convert_lerobot(ConversionSettings(dataset, tmp_path / "out", cameras=("base_camera",), depth=False))
    assert len(done.episodes) == 2


def test_cameras_may_differ(tmp_path):
    """Our own don't; a camera's own size is what its pictures have to have."""
    trajectory = write_trajectory(tmp_path / "F.h5", seeds=(1, 2))
    convert(ConversionSettings(trajectory, tmp_path / "ds", embeddings=False, video=False, open_renderer=RayCaster))
    for path in (tmp_path / "ds").glob("episode_*/gripper_camera/*/*.png"):
        shrink(path, (32, 24))
    assert len(convert_lerobot(ConversionSettings(tmp_path / "ds", tmp_path / "out")).episodes) == 2


def sides_of(root):
    settings = LeRobotDataset(root).settings
    return settings["train_eps"], settings["val_eps"]


def test_the_split_is_the_folders_own(tmp_path):
    """What validates after --append, merge or split must not train in the copy."""
    root = make(tmp_path, "ds", range(6))
    edit(root / "episode_0000002" / "scene.json", lambda c: c.update(success=False))
    convert_lerobot(ConversionSettings(root, tmp_path / "before", include_failed=True))
    resplit(root, Share(0.5))
    train, val = Dataset(root).sides
    assert sides_of(tmp_path / "before") != (train, val)  # that of the rule alone
    convert_lerobot(ConversionSettings(root, tmp_path / "all", include_failed=True))
    assert sides_of(tmp_path / "all") == (train, val)
    convert_lerobot(ConversionSettings(root, tmp_path / "good"))  # without episode 2: numbers move up
    moved = [[n - (n > 2) for n in side if n != 2] for side in (train, val)]
    assert list(sides_of(tmp_path / "good")) == moved


def test_an_episode_that_no_side_lists(tmp_path):
    """The others keep their side; without an overview it is the rule for all."""
    root = make(tmp_path, "ds", range(6))
    edit(root / "data_info.json", lambda c: c.update(train_eps=[0, 1], val_eps=[2, 3]))
    convert_lerobot(ConversionSettings(root, tmp_path / "some"))
    assert sides_of(tmp_path / "some") == ([0, 1, 4, 5], [2, 3])
    (root / "data_info.json").unlink()
    convert_lerobot(ConversionSettings(root, tmp_path / "none"))
    assert sides_of(tmp_path / "none") == split_by_seed({n: n for n in range(6)})


@pytest.mark.parametrize(("array", "value"), [("ee_pos", np.nan), ("rel_orn", np.inf), ("gripper_width", -np.inf)])
def test_nan_is_an_error_of_its_episode_and_array(dataset, tmp_path, array, value):
    spoilt = arrays_of(dataset / "episode_0000001")[array]
    spoilt[3] = value
    change(dataset / "episode_0000001", **{array: spoilt})
    with pytest.raises(DatasetError) as caught:
        convert_lerobot(ConversionSettings(dataset, tmp_path / "out"))
    where = dataset / "episode_0000001" / "episode_info.npz"
    assert f"{where}, {array}: this array holds NaN or infinity. " in str(caught.value)


def test_a_dataset_without_videos_has_no_depth(dataset, tmp_path):
    """As others make them."""
    convert_lerobot(ConversionSettings(dataset, tmp_path / "out"))
    assert LeRobotDataset(tmp_path / "out").has_depth
    drop = lambda info: [info["features"].pop(key) for key in list(info["features"]) if "images" in key]  # noqa: E731
    edit(tmp_path / "out/meta/info.json", drop)
    shutil.rmtree(tmp_path / "out/videos")
    other = LeRobotDataset(tmp_path / "out")
    assert (other.cameras, other.has_depth, other.episode(1).has_depth) == ((), False, False)
    assert open_source(tmp_path / "out").index()["cameras"] == []
