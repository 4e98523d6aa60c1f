"""Contact sheets of two builtin assets, and the camera that draws them."""

import numpy as np
import pytest
from PIL import Image

from asset_tools.contact_sheet import CAPTION, CELLS, GAP, LABEL, LARGE, write_contact_sheet
from asset_tools.renderer import PAPER, RenderBody, Renderer, make_box_faces
from robocas_ms3.assets.pack import load_pack
from robocas_ms3.core.errors import AssetError


@pytest.fixture(scope="module")
def studio(needs_renderer):
    """Kept for all tests: as long as one is alive, others start at once."""
    return Renderer(64)


def share(image, channel):
    """Return the fraction of the image in which a colour channel dominates."""
    values = np.asarray(image).astype(int)
    others = np.delete(values, channel, axis=2).max(axis=2)
    return float((values[..., channel] > others + 40).mean())


@pytest.mark.slow
def test_a_contact_sheet_shows_the_requested_assets(tmp_path, studio):
    pack = load_pack("builtin")
    write_contact_sheet(pack, tmp_path / "new" / "sheet.png", ids=["tomato_soup_can", "cabinet"])
    sheet = Image.open(tmp_path / "new" / "sheet.png").convert("RGB")
    width, height = CELLS * LARGE, CAPTION + LARGE + LABEL
    assert sheet.size == (2 * width + 3 * GAP, height + 2 * GAP)
    cells = [
        np.asarray(sheet.crop((left, GAP + CAPTION, left + LARGE, GAP + CAPTION + LARGE)))
        for left in (GAP + asset * (width + GAP) + i * LARGE for asset in (0, 1) for i in range(CELLS))
    ]
    assert all(cell.std() > 10 for cell in cells[: CELLS + 2])  # an object's five; furniture shut and open
    assert not (cells[CELLS] == cells[CELLS + 1]).all()
    assert (np.asarray(sheet.crop((GAP, GAP, GAP + width, GAP + CAPTION))) < 90).any()  # a caption
    with pytest.raises(AssetError, match="found blue_box"):
        write_contact_sheet(pack, tmp_path / "sheet.png", ids=["blue_box"])


@pytest.mark.slow
def test_the_camera_renders_from_the_given_direction(studio):
    # a red and a blue cube, side by side along y: from +x red, which is at +y, is on the right
    cubes = [
        RenderBody(faces.reshape(-1, 3), faces=faces, colour=colour)
        for faces, colour in (
            (make_box_faces((-0.5, 1, -0.5), (0.5, 2, 0.5)), (0.9, 0.05, 0.05)),
            (make_box_faces((-0.5, -2, -0.5), (0.5, -1, 0.5)), (0.05, 0.05, 0.9)),
        )
    ]
    image = studio.render(cubes, 0, 0)
    left, right = image.crop((0, 0, 32, 64)), image.crop((32, 0, 64, 64))
    # 4 m and a margin of 6 % across 64 pixels, so that a cube of 1 m is 15 pixels high
    assert share(right, 0) == pytest.approx(0.11, abs=0.02)  # 15 x 15 of 32 x 64 pixels
    assert share(left, 2) == pytest.approx(0.11, abs=0.02)
    assert share(left, 0) == share(right, 2) == 0
    assert image.getpixel((32, 2)) == PAPER
