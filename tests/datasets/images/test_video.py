import imageio.v2 as imageio
import numpy as np
import pytest
from PIL import Image

from robocas_ms3.cli.main import run
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.files import atomic_file
from robocas_ms3.datasets.images.preview_frames import THUMBNAIL, EpisodeDrawer
from robocas_ms3.datasets.images.video import PANEL, colour_depth, open_video, write_contact_sheet, write_video
from robocas_ms3.datasets.sources.reader import Dataset


def video_frame(episode, step, number=0):
    images = {camera: episode.rgb(camera, step) for camera in episode.cameras}
    return EpisodeDrawer(number, episode.arrays, 5).draw_frame(step, images, PANEL)


def test_videos_show_every_step_in_real_time(made, tmp_path):
    path = write_video(Dataset(made), 1, tmp_path / "e.mp4")
    with imageio.get_reader(path) as video:
        facts = video.get_meta_data()
        frames = [frame for frame in video]
    assert facts["fps"] == 5
    assert facts["codec"] == "h264"
    assert facts["pix_fmt"].startswith("yuv420p")
    assert len(frames) == 7
    assert frames[0].shape == (320 + 64, 3 * 426, 3)
    drawn = video_frame(Dataset(made).episode(1), 6, 1)
    assert np.abs(frames[6].astype(int) - drawn).mean() < 4, "H.264 loses little"


def test_a_failed_video_leaves_no_file(tmp_path):
    """FFmpeg once continued after the error and wrote its file again."""
    with pytest.raises(ZeroDivisionError), atomic_file(tmp_path / "e.mp4") as tmp, open_video(tmp, 5) as video:
        video.append_data(np.zeros((16, 16, 3), np.uint8))
        _ = 1 / 0
    assert video.closed
    assert list(tmp_path.iterdir()) == []


def test_a_frame_shows_cameras_and_texts(made):
    episode = Dataset(made).episode(0)
    frame = video_frame(episode, 2)
    assert frame.shape == (384, 1278, 3)
    width, height = PANEL
    for index, camera in enumerate(("base_camera", "gripper_camera", "static_camera")):
        panel = frame[:height, index * width : (index + 1) * width]
        original = episode.rgb(camera, 2)
        middle = panel[height // 2, width // 2], original[24, 32]
        np.testing.assert_array_equal(*middle)
    band = frame[height:]
    light = (band.min(axis=2) > 200).sum()
    assert 500 < light < 5000, "the instruction is drawn there"
    other = video_frame(episode, 4)[height:]
    assert (band != other).any(axis=2).sum() > 300, "another sub-goal, another text"


def test_long_texts_stay_inside(made, tmp_path):
    episode = Dataset(made).episode(0)
    episode.arrays["language_goal"] = np.array("grasp the very long named thing " * 6)
    frame = video_frame(episode, 0)
    assert (frame[320:, -8:].max(axis=2) < 60).all()


def test_contact_sheet(made, tmp_path):
    sheet = np.asarray(Image.open(write_contact_sheet(Dataset(made), tmp_path / "sheet.png")))
    (width, height), part = THUMBNAIL, 30 + 3 * 163 + 10
    assert sheet.shape == (2 * part, 110 + 8 * (width + 3), 3)
    # Row of episode 1, static camera, last column: its last step.
    row, column = part + 30 + 2 * (height + 3) + height // 2, 110 + 7 * (width + 3) + width // 2
    np.testing.assert_array_equal(sheet[row, column], Dataset(made).episode(1).rgb("static_camera", 6)[24, 32])


def test_depth_colours():
    colours = colour_depth(np.array([[0, 30, 5000, 60000]], np.uint16))
    assert colours[0, 0].tolist() == [0, 0, 0]
    assert colours[0, 1, 0] > colours[0, 1, 2], "near is red"
    assert colours[0, 2].tolist() == colours[0, 3].tolist()


def test_steps_of_a_row(made):
    arrays = Dataset(made).episode(0).arrays
    for count, steps in ((65, [0, 9, 18, 27, 37, 46, 55, 64]), (3, [0, 0, 1, 1, 1, 1, 2, 2])):
        assert EpisodeDrawer(0, arrays | {"step_lang_goals": np.array(["x"] * count)}, 5).row_steps == steps


def test_errors(made, tmp_path):
    for number, speed in ((9, 1.0), (0, 0), (0, -1.0), (0, float("nan")), (0, float("inf"))):
        with pytest.raises(DatasetError):
            write_video(Dataset(made), number, tmp_path / "e.mp4", speed=speed)
    assert run(["video", str(made), "--out", str(tmp_path / "out"), "--episodes", "0", "9"]) == 2
    assert list(tmp_path.iterdir()) == []
