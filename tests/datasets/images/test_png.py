"""PNG as other programs read it."""

import io

import cv2
import numpy as np
import pytest
from PIL import Image

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets.images.image_files import read_image, write_image
from robocas_ms3.datasets.images.image_headers import read_header
from robocas_ms3.datasets.images.png import encode_png

RGB, DEPTH, GREY = (np.uint8, (3,)), (np.uint16, ()), (np.uint8, ())


def arrays(kind, height, width):
    dtype, channels = kind
    top = np.iinfo(dtype).max
    shape = (height, width, *channels)
    ramp = np.arange(np.prod(shape)).reshape(shape)
    yield np.random.default_rng(height).integers(0, top, shape, dtype, endpoint=True)
    yield (ramp * (top // 97)).astype(dtype)  # wraps round
    yield np.zeros(shape, dtype)
    yield np.full(shape, top, dtype)


@pytest.mark.parametrize(("height", "width"), [(1, 1), (3, 1), (1, 5), (16, 16), (17, 31), (120, 161)])
@pytest.mark.parametrize("kind", [RGB, DEPTH, GREY], ids=["rgb", "depth", "grey"])
def test_decodes_to_the_same(kind, height, width, tmp_path):
    for pixels in arrays(kind, height, width):
        data = encode_png(pixels)
        decoded = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        seen = decoded[..., ::-1] if pixels.ndim == 3 else decoded
        assert seen.dtype == pixels.dtype
        np.testing.assert_array_equal(seen, pixels)
        with Image.open(io.BytesIO(data)) as image:
            np.testing.assert_array_equal(np.asarray(image, pixels.dtype), pixels)
        path = tmp_path / "image.png"
        write_image(path, pixels)
        np.testing.assert_array_equal(read_image(path), pixels)
        header = read_header(path)  # its checksums too
        assert (header.width, header.height, header.bits * header.channels) == (
            width,
            height,
            24 if pixels.ndim == 3 else 8 * pixels.itemsize,
        )


def test_views_of_arrays(tmp_path):
    """Of a slice of RGBA, upside down, every other pixel."""
    rgba = np.random.default_rng(0).integers(0, 256, (40, 30, 4), np.uint8)
    depth = np.random.default_rng(0).integers(0, 2**16, (40, 30), np.uint16)
    for view in (rgba[::-1, ::2, :3], depth.T, depth[::2, ::-1]):
        write_image(tmp_path / "view.png", view)
        np.testing.assert_array_equal(read_image(tmp_path / "view.png"), view)


def test_size_is_close_to_opencv():
    """Of images like rendered ones, shaded and grained, at the level and filter that it takes for fast."""
    rng = np.random.default_rng(0)
    shades = cv2.GaussianBlur(rng.normal(128, 2000, (240, 320, 3)), (0, 0), 12)
    rgb = np.clip(shades + rng.normal(0, 2, shades.shape), 0, 255).astype(np.uint8)
    rows, columns = np.mgrid[:240, :320]
    planes = 1 / (0.4 + rows / 500 + columns / 3000), 1 / (0.2 + rows / 9000 + columns / 1000)
    depth = (1000 * np.minimum(*planes)).astype(np.uint16)  # a table before a wall, as seen from aslant
    for pixels in (rgb, depth):
        opencvs = len(cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1])
        assert len(encode_png(pixels)) < 1.1 * opencvs


@pytest.mark.parametrize(
    "pixels",
    [
        np.zeros((4, 5), np.int16),
        np.zeros((4, 5, 4), np.uint8),
        np.zeros((4, 5, 3), np.uint16),
        np.zeros((4, 5), np.float32),
        np.zeros((0, 5), np.uint16),
        np.zeros((5, 0, 3), np.uint8),
    ],
    ids=lambda pixels: f"{pixels.dtype}{pixels.shape}",
)
def test_unsupported_images_are_refused(pixels, tmp_path):
    with pytest.raises(DatasetError, match="can't encode this image"):
        write_image(tmp_path / "a.png", pixels)
    assert list(tmp_path.iterdir()) == []
