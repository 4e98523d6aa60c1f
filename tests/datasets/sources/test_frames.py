"""Consecutive images: equal to single reads, and videos are always closed."""

import errno
import inspect
from types import SimpleNamespace

import numpy as np
import pytest
from synthetic import RayCaster

pytest.importorskip("av", reason="needs the extra 'lerobot'")
pytest.importorskip("pyarrow", reason="needs the extra 'lerobot'")

from robocas_ms3.datasets.conversion.settings import ConversionSettings
from robocas_ms3.datasets.formats import open_source
from robocas_ms3.datasets.lerobot import reader, video
from robocas_ms3.datasets.lerobot.convert import convert_lerobot
from robocas_ms3.datasets.sources.episode_source import iter_images

CAMERAS = ("base_camera", "gripper_camera", "static_camera")
STEPS = 7


@pytest.fixture(scope="module")
def lerobot(made, tmp_path_factory):
    """A dataset of two episodes, for reading only."""
    out = tmp_path_factory.mktemp("lerobot") / "dataset"
    convert_lerobot(ConversionSettings(made, out, open_renderer=RayCaster))
    return out


@pytest.fixture
def folders(made, lerobot):
    return {"robocas": made, "lerobot": lerobot}


@pytest.fixture
def runs(monkeypatch):
    """All open frame generators; referenced here, so that none is closed by garbage collection."""
    found, read = [], reader.read_frames

    def held(*args):
        found.append(read(*args))
        return found[-1]

    monkeypatch.setattr(reader, "read_frames", held)
    return found


def all_closed(runs):
    return {inspect.getgeneratorstate(run) for run in runs} == {inspect.GEN_CLOSED}


@pytest.mark.parametrize("name", ["robocas", "lerobot"])
@pytest.mark.parametrize("kind", ["rgb", "depth"])
def test_frames_equal_single_images(folders, name, kind):
    episode = open_source(folders[name]).episode(1)
    for camera in episode.cameras:
        alone = [getattr(episode, kind)(camera, step) for step in range(STEPS)]
        for span, steps in (((), range(STEPS)), ((3,), range(3, STEPS)), ((1, 4), range(1, 5)), ((2, 0), ())):
            run = list(episode.frames(camera, kind, *span))
            assert len(run) == len(steps)
            for image, step in zip(run, steps, strict=True):
                np.testing.assert_array_equal(image, alone[step])


def test_all_videos_are_closed_with_the_generator(lerobot, runs):
    episode = open_source(lerobot).episode(0)
    run = iter_images(episode, CAMERAS, "depth")
    seen = [next(run), next(run)]
    assert len(runs) == 3
    assert not all_closed(runs)
    run.close()
    assert all_closed(runs)
    for step, image_options in enumerate(seen):
        assert list(image_options) == list(CAMERAS)
        for camera in CAMERAS:
            np.testing.assert_array_equal(image_options[camera], episode.depth(camera, step))


def test_failed_conversion_leaves_no_video_open(lerobot, tmp_path, runs, monkeypatch):
    add = video.VideoEncoder.add

    def full(self, image):
        if self.frames == 2:
            raise OSError(errno.ENOSPC, "no space left")
        add(self, image)

    monkeypatch.setattr(video.VideoEncoder, "add", full)
    with pytest.raises(OSError, match="No space left"):
        convert_lerobot(ConversionSettings(lerobot, tmp_path / "out"))
    assert runs
    assert all_closed(runs)


def test_an_episode_without_cameras_has_steps_without_images():
    assert list(iter_images(SimpleNamespace(steps=2), ())) == [{}, {}]
