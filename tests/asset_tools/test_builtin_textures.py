import io

import numpy as np
import pytest

from asset_tools.builtin.motifs import MOTIFS
from asset_tools.builtin.objects import SPECS
from asset_tools.builtin.products import LABELS
from asset_tools.builtin.textures import Canvas, noise

WHITE, BLACK = (255, 255, 255), (0, 0, 0)


def spec(name):
    return next(s for s in SPECS if s.id == name)


def canvas(size=(0.1, 0.05)):
    return Canvas(size, 2000, WHITE, np.random.default_rng(0))


def dark_box(image):
    rows, columns = np.nonzero(np.asarray(image.convert("L")) < 128)
    return columns.min(), rows.min(), columns.max() + 1, rows.max() + 1


@pytest.mark.parametrize("words", ["SUGAR", "TOMATO\nSOUP", "Qg", "a long line of small print"])
@pytest.mark.parametrize("turn", [0, 90])
def test_text_fills_its_box_and_stays_inside(words, turn):
    page = canvas()
    page.text(words, (0.1, 0.2, 0.9, 0.8), BLACK, bold=0.05, turn=turn)
    left, top, right, bottom = dark_box(page.image)
    assert left >= 0.1 * page.width - 2 and right <= 0.9 * page.width + 2
    assert top >= 0.2 * page.height - 2 and bottom <= 0.8 * page.height + 2
    assert (right - left) / (0.8 * page.width) > 0.85 or (bottom - top) / (0.6 * page.height) > 0.85


def test_turned_text_reads_upwards():
    flat, turned = canvas((0.1, 0.1)), canvas((0.1, 0.1))
    flat.text("F", (0, 0, 1, 1), BLACK)
    turned.text("F", (0, 0, 1, 1), BLACK, turn=90)
    difference = np.asarray(flat.image.rotate(90)).astype(int) - np.asarray(turned.image)
    assert np.abs(difference).mean() < 3


def test_texts_alike_get_letters_of_one_size():
    one, two = canvas(), canvas()
    one.text("xx", (0, 0, 1, 1), BLACK, like=("xxxxxxxx",))
    two.text("xxxxxxxx", (0, 0, 1, 1), BLACK)
    a, b = dark_box(one.image), dark_box(two.image)
    assert a[3] - a[1] == pytest.approx(b[3] - b[1], abs=2)


def test_every_motif_draws_within_its_circle():
    for name, draw in MOTIFS.items():
        page = Canvas((100, 100), 1, (1, 2, 3), np.random.default_rng(0))
        draw(page.draw, 50, 50, 30)
        rows, columns = np.nonzero((np.asarray(page.image) != (1, 2, 3)).any(2))
        assert len(rows) > 300, name
        assert min(rows.min(), columns.min()) >= 12 and max(rows.max(), columns.max()) <= 88, name
    assert {label.motif for label in LABELS.values()} <= set(MOTIFS)


def test_noise_is_bounded_and_repeats_with_its_seed():
    points = np.random.default_rng(1).normal(size=(500, 3))
    first = noise(points, np.random.default_rng(2), frequency=1.0)
    assert np.abs(first).max() <= 1 and first.std() > 0.2
    np.testing.assert_array_equal(first, noise(points, np.random.default_rng(2), frequency=1.0))


@pytest.mark.parametrize("name", ["apple", "orange", "banana"])
def test_skins_have_no_seam(name):
    """The left and right ends of an unrolled skin meet on the fruit."""
    shape, mesh = spec(name).build()
    image = np.asarray(mesh.visual.material.baseColorTexture).astype(float)
    left, top, right, bottom = shape.regions["skin"].box
    skin = image[top:bottom, left:right]
    seam = np.abs(skin[:, 0] - skin[:, -1]).mean()
    inside = np.abs(np.diff(skin, axis=1)).mean()
    assert seam < 2 * inside + 3


@pytest.mark.parametrize("name", ["tomato_soup_can", "lemon"])
def test_same_bytes_twice(name):
    def data():
        _, mesh = spec(name).build()
        texture = io.BytesIO()
        mesh.visual.material.baseColorTexture.save(texture, "PNG")
        return mesh.vertices.tobytes(), mesh.faces.tobytes(), mesh.visual.uv.tobytes(), texture.getvalue()

    assert data() == data()


def test_textures_are_small_jpegs():
    for name in ("tomato_soup_can", "apple", "mug"):
        _, mesh = spec(name).build()
        image = mesh.visual.material.baseColorTexture
        assert image.format == "JPEG" and image.size == (512, 512)
