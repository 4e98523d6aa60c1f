import numpy as np
import pytest
from synthetic import RayCaster

pytest.importorskip("av", reason="needs the extra 'lerobot'")
pytest.importorskip("pyarrow", reason="needs the extra 'lerobot'")

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets.lerobot.convert import convert_lerobot
from robocas_ms3.datasets.lerobot.reader import LeRobotDataset
from robocas_ms3.datasets.lerobot.video import CODINGS, DEPTH_INFO, Encoder, read_frames, to_depth, to_levels
from robocas_ms3.datasets.writing.settings import ConversionSettings


def test_depth_in_range_is_exact():
    depth = np.arange(4096, dtype=np.uint16).reshape(64, 64)
    np.testing.assert_array_equal(to_depth(to_levels(depth), DEPTH_INFO), depth)
    farther = np.array([[4095, 4096, 65535]], np.uint16)
    np.testing.assert_array_equal(to_depth(to_levels(farther), DEPTH_INFO), [[4095, 4095, 4095]])


def test_levels_of_lerobots_own_datasets():
    """Logarithmic by default: level 0 is 10 mm, the last one 10 m, and the middle exp of the middle."""
    middle = np.sqrt(3.51 * 13.5) - 3.5
    found = to_depth(np.array([[0, 4095]], np.uint16), {})
    np.testing.assert_array_equal(found, [[10, 10000]])
    assert abs(float(to_depth(np.array([[2047]], np.uint16), {})[0, 0]) - middle * 1000) < 3
    linear = {"video.depth_min": 1.0, "video.depth_max": 2.0, "video.use_log": False}
    np.testing.assert_array_equal(to_depth(np.array([[0, 819, 4095]], np.uint16), linear), [[1000, 1200, 2000]])


@pytest.mark.parametrize(
    "info",
    [
        {"video.depth_min": 3.0, "video.depth_max": 1.0},
        {"video.depth_max": "far"},
        {"video.shift": -1.0},
        {"video.depth_max": float("nan")},
        {"video.use_log": 0},
    ],
)
def test_invalid_ranges_are_refused(info):
    with pytest.raises(DatasetError, match="invalid range of a depth video"):
        to_depth(np.zeros((2, 2), np.uint16), info)


def test_the_video_is_lossless_and_the_same_each_time(tmp_path):
    noise = np.random.default_rng(0).integers(0, 4096, (9, 48, 64), np.uint16)
    for name in ("a.mp4", "b.mp4"):
        with Encoder(tmp_path / name, CODINGS["depth12"], 5, (64, 48)) as encoder:
            for picture in noise:
                encoder.add(picture)
    assert (tmp_path / "a.mp4").read_bytes() == (tmp_path / "b.mp4").read_bytes()
    for first, count in ((0, 9), (4, 3), (7, 2)):
        frames = np.stack(list(read_frames(tmp_path / "a.mp4", first, count, 5)))
        np.testing.assert_array_equal(frames, noise[first : first + count])


def test_depth_out_of_range_is_reported_once(trajectory, tmp_path, caplog):
    convert_lerobot(ConversionSettings(trajectory, tmp_path / "out", open_renderer=RayCaster))  # its room is 5 m deep
    said = [record.getMessage() for record in caplog.records if "depth" in record.getMessage()]
    assert said == ["2 episodes: depth above 4095 mm is stored as 4095 mm"]
    episode = LeRobotDataset(tmp_path / "out").episode(0)
    assert max(episode.depth(camera, 0).max() for camera in episode.cameras) == 4095
