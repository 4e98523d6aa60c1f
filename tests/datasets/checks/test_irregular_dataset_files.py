"""Pipes, devices and files of absurd sizes in a dataset: one violation or one typed error each, at once."""

import shutil
import struct
import zlib

import cv2
import numpy as np
import pytest
from irregular import KINDS, replace_file

from robocas_ms3.core.documents import DocumentError
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets.checks.dataset import validate
from robocas_ms3.datasets.conversion.episode_folder import find_damaged_file
from robocas_ms3.datasets.images.image_files import ImageOptions, read_image
from robocas_ms3.datasets.images.image_headers import LARGEST, read_header
from robocas_ms3.datasets.manage.copy_episodes import FileCopier
from robocas_ms3.datasets.sources.reader import Dataset
from robocas_ms3.demos.recordings.trajectory_hdf5 import open_trajectory
from robocas_ms3.robots.cameras import STANDARD_CAMERA_NAMES
from robocas_ms3.viewer.source import open_content

EPISODE = "episode_0000001"
IMAGES = ("base_camera/rgb/0002.png", "base_camera/depth/0003.png")


@pytest.mark.parametrize("kind", KINDS)
def test_validate_reports_irregular_files(dataset, kind):
    names = {f"{EPISODE}/{name}" for name in IMAGES} | {f"{EPISODE}/scene.json"}
    for name in names:
        replace_file(dataset / name, kind)
    files = [violation.file for violation in validate(dataset).violations]
    assert set(files) == names
    assert len(files) == len(names)
    replace_file(dataset / f"{EPISODE}/episode_info.npz", kind)
    replace_file(dataset / "data_info.json", kind)
    files = {violation.file for violation in validate(dataset).violations}
    assert {f"{EPISODE}/episode_info.npz", "data_info.json"} <= files


@pytest.mark.parametrize("kind", KINDS)
def test_image_readers_refuse_irregular_files(dataset, kind):
    paths = [replace_file(dataset / EPISODE / name, kind) for name in IMAGES]
    source, content = Dataset(dataset).episode(1), open_content(dataset)
    for read in (source.rgb, lambda *place: content.rgb(1, *place)):
        with pytest.raises(DatasetError) as error:
            read("base_camera", 2)
        assert error.value.where == paths[0]
    for read in (source.depth, lambda *place: content.depth(1, *place)):
        with pytest.raises(DatasetError) as error:
            read("base_camera", 3)
        assert error.value.where == paths[1]


def test_other_readers_refuse_irregular_files(dataset, tmp_path):
    for kind in ("pipe", "device"):
        with pytest.raises(DatasetError):
            open_trajectory(replace_file(tmp_path / "F.h5", kind))
        with pytest.raises(DocumentError):
            FileCopier(link=False).copy_file(replace_file(tmp_path / "F.h5", kind), tmp_path / "copy")
        path = replace_file(dataset / EPISODE / IMAGES[0], kind)
        assert find_damaged_file(dataset / EPISODE, ImageOptions(STANDARD_CAMERA_NAMES)) == path
        path.unlink()
        shutil.copy(path.with_name("0001.png"), path)


def png_of(width, height):
    """A small PNG whose header declares a large size."""

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    parts = chunk(b"IHDR", header), chunk(b"IDAT", zlib.compress(bytes(1000))), chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


@pytest.mark.parametrize("size", [(LARGEST + 1, 1), (1, LARGEST + 1), (20_000, 20_000), (2**31 - 1, 2**31 - 1)])
def test_too_large_images_are_not_decoded(tmp_path, monkeypatch, size):
    path = tmp_path / "a.png"
    path.write_bytes(png_of(*size))
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("the image is decoded"))
    with pytest.raises(DocumentError):
        read_header(path)
    with pytest.raises(DatasetError) as error:
        read_image(path)
    assert error.value.where == path


def test_images_of_the_largest_size_are_read(tmp_path):
    for suffix in (".png", ".jpg", ".webp"):
        path = tmp_path / f"a{suffix}"
        cv2.imwrite(str(path), np.zeros((2, LARGEST, 3), np.uint8))
        assert read_header(path).width == LARGEST
        assert read_image(path).shape == (2, LARGEST, 3)
