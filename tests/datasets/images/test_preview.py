"""Videos and contact sheet of `robocas convert`, made during rendering."""

import imageio.v2 as imageio
import numpy as np
import pytest
from managing import files_of
from PIL import Image
from synthetic import RayCaster, render_by, write_trajectory

from robocas_ms3.cli.main import run
from robocas_ms3.datasets.checks.dataset import validate
from robocas_ms3.datasets.conversion import convert as conversion
from robocas_ms3.datasets.conversion.settings import ConversionSettings
from robocas_ms3.datasets.images import video
from robocas_ms3.datasets.images.preview_frames import EpisodeDrawer
from robocas_ms3.datasets.images.video import PREVIEW_PANEL, write_contact_sheet
from robocas_ms3.datasets.sources.reader import Dataset


@pytest.fixture
def stub_images(monkeypatch):
    monkeypatch.setattr(conversion, "convert", render_by(RayCaster, conversion.convert))


def converted(path, out, *flags, seeds=None):
    trajectory = path if seeds is None else write_trajectory(path, seeds=seeds)
    return run(["convert", str(trajectory), "--out", str(out), "--no-embeddings", *flags])


def shown(out):
    return sorted(path.name for path in (out / "preview").iterdir()) if (out / "preview").is_dir() else []


def test_preview_shows_the_stored_images(trajectory, tmp_path, monkeypatch):
    out, settings = tmp_path / "out", {"embeddings": False, "open_renderer": RayCaster}
    with monkeypatch.context() as patch:
        patch.delattr("robocas_ms3.datasets.sources.reader.read_image")  # no image is read back
        conversion.convert(ConversionSettings(trajectory, out, **settings))
        conversion.convert(ConversionSettings(trajectory, tmp_path / "by processes", jobs=2, **settings))
    assert files_of(tmp_path / "by processes") == files_of(out)
    assert shown(out) == ["contact_sheet.png", "episode_0000000.mp4", "episode_0000001.mp4"]
    dataset = Dataset(out)
    for number in dataset.numbers:
        with imageio.get_reader(out / "preview" / f"episode_{number:07d}.mp4") as reader:
            assert reader.get_meta_data()["fps"] == 5
            frames = [frame for frame in reader]  # list() asks for a length that it does not have
        assert len(frames) == 7
        episode = dataset.episode(number)
        for step, frame in enumerate(frames):
            images = {camera: episode.rgb(camera, step) for camera in episode.cameras}
            drawn = EpisodeDrawer(number, episode.arrays, 5).draw_frame(step, images, PREVIEW_PANEL)
            assert frame.shape == drawn.shape == (PREVIEW_PANEL[1] + 64, 3 * PREVIEW_PANEL[0], 3)
            assert np.abs(frame.astype(int) - drawn).mean() < 4, "H.264 loses little"
    of_images = np.asarray(Image.open(write_contact_sheet(Dataset(out), tmp_path / "sheet.png")))
    np.testing.assert_array_equal(np.asarray(Image.open(out / "preview" / "contact_sheet.png")), of_images)
    assert validate(out).violations == []


def test_preview_of_new_episodes(stub_images, tmp_path):
    out, sheets, times = tmp_path / "out", [], []
    for name, seeds, flags in (("a", (1, 2), ()), ("b", (3,), ("--append",)), ("b", (3,), ("--append",))):
        assert converted(tmp_path / f"{name}.h5", out, *flags, seeds=seeds) == 0
        sheet = out / "preview" / "contact_sheet.png"
        sheets.append(Image.open(sheet).height)
        times.append([path.stat().st_mtime_ns for path in sorted((out / "preview").glob("*.mp4"))])
    assert [len(each) for each in times] == [2, 3, 3]
    assert times[1][:2] == times[0]
    assert times[2] == times[1]
    assert sheets[1] == sheets[2] == 1.5 * sheets[0]
    of_images = np.asarray(Image.open(write_contact_sheet(Dataset(out), tmp_path / "sheet.png")))
    np.testing.assert_array_equal(np.asarray(Image.open(sheet)), of_images)


def test_previews_of_many_episodes_with_all_videos(stub_images, tmp_path, monkeypatch, capsys):
    hint = "no videos were written, because there are more than 20 episodes: pass --all-videos"
    monkeypatch.setattr(conversion, "MAX_PREVIEWS", 2)  # of 20 they take seconds
    monkeypatch.setattr(video, "SHEET_EPISODES", 2)
    path = write_trajectory(tmp_path / "three.h5", seeds=(1, 2, 3))
    assert converted(path, tmp_path / "three") == 0
    assert shown(tmp_path / "three") == []
    assert hint in capsys.readouterr().out
    assert converted(path, tmp_path / "three", "--all-videos", "--overwrite") == 0
    videos = [f"episode_{number:07d}.mp4" for number in range(3)]
    assert shown(tmp_path / "three") == ["contact_sheet.png", *videos]
    assert hint not in capsys.readouterr().out
    assert Image.open(tmp_path / "three" / "preview" / "contact_sheet.png").height == 2 * (30 + 3 * 163 + 10)
    path = write_trajectory(tmp_path / "two.h5", seeds=(1, 2))
    assert converted(path, tmp_path / "two") == 0
    assert shown(tmp_path / "two") == ["contact_sheet.png", *videos[:2]]


def test_previews_can_be_switched_off(trajectory, stub_images, tmp_path, capsys):
    assert converted(trajectory, tmp_path / "out", "--no-video") == 0
    assert shown(tmp_path / "out") == []
    assert "video" not in capsys.readouterr().out
    assert converted(trajectory, tmp_path / "other", "--no-video", "--all-videos") == 2
    assert "--no-video: can't be combined with --all-videos" in capsys.readouterr().err
    assert not (tmp_path / "other").exists()


def test_failed_episode_has_no_preview(trajectory, tmp_path, monkeypatch):
    from robocas_ms3.datasets.conversion import episode_folder

    done, write = [], episode_folder.write_image

    def failing(path, image):
        done.append(path)
        if len(done) > 50:  # in the second episode
            raise OSError(28, "No space left on device")
        return write(path, image)

    monkeypatch.setattr(episode_folder, "write_image", failing)
    with pytest.raises(OSError, match="No space left"):
        conversion.convert(
            ConversionSettings(trajectory, tmp_path / "out", embeddings=False, all_videos=True, open_renderer=RayCaster)
        )
    assert shown(tmp_path / "out") == ["episode_0000000.mp4"]
