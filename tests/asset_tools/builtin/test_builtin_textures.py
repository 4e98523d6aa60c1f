import itertools
from functools import cache

import numpy as np
import pytest
import trimesh
from PIL import ImageFont
from scipy.ndimage import binary_dilation

from asset_tools.builtin.catalogue import load_builtin_products
from asset_tools.builtin.textures import OVERSAMPLING

WHITE, BLACK = (255, 255, 255), (0, 0, 0)
HOUSEHOLD = [p for p in load_builtin_products().values() if not p.model and p.category not in ("ball", "toy")]
LABELS = {p.id: p.paint.label for p in load_builtin_products().values() if hasattr(p.paint, "label")}


@cache
def built(name):
    return load_builtin_products()[name].build()


@pytest.mark.parametrize("name", ["apple", "orange", "banana"])
def test_skins_have_no_seam(name):
    """The left and right ends of an unrolled skin meet on the fruit."""
    shape, mesh = built(name)
    image = np.asarray(mesh.visual.material.baseColorTexture).astype(float)
    left, top, right, bottom = shape.regions["skin"].box
    skin = image[top:bottom, left:right]
    seam = np.abs(skin[:, 0] - skin[:, -1]).mean()
    inside = np.abs(np.diff(skin, axis=1)).mean()
    assert seam < 2 * inside + 3


def luminance(pixels):
    """Relative luminance as in WCAG 2 of (..., 3) sRGB values in 0..255."""
    part = pixels / 255
    linear = np.where(part <= 0.04045, part / 12.92, ((part + 0.055) / 1.055) ** 2.4)
    return linear @ np.array([0.2126, 0.7152, 0.0722])


@pytest.mark.parametrize("name", LABELS)
def test_titles_are_legible(name, monkeypatch):
    """Letters of the title have 14 pixels in the texture at least, and stand out from what is right around them."""
    sizes = []
    load = ImageFont.load_default
    monkeypatch.setattr(ImageFont, "load_default", lambda size: sizes.append(size) or load(size))
    _, mesh = load_builtin_products()[name].build()
    assert max(size for size in sizes if size != 100) / OVERSAMPLING >= 14  # 100: only measured with
    texture = np.asarray(mesh.visual.material.baseColorTexture).astype(float)
    ink = np.abs(texture - LABELS[name].ink).max(2) < 30
    assert ink.sum() > 300
    around = binary_dilation(ink, iterations=3) & ~binary_dilation(ink)
    dark, light = sorted([np.median(luminance(texture[ink])), np.median(luminance(texture[around]))])
    # WCAG asks 3 for large letters; those pressed into a bar of soap show by their shade alone
    assert (light + 0.05) / (dark + 0.05) >= (1.5 if name == "soap" else 3)


@cache
def look(name, seed=None):
    """Colours over the surface (216,) and half widths (2, 60) in x and y every 5 mm of the height, m."""
    entry = load_builtin_products()[name]
    shape, mesh = built(name)
    image = mesh.visual.material.baseColorTexture
    if seed is not None:
        image = entry.paint(shape, np.random.default_rng(seed))
    surface = trimesh.Trimesh(shape.vertices, shape.faces, process=False)
    points, faces = trimesh.sample.sample_surface(surface, 20000, seed=0)[:2]
    weights = trimesh.triangles.points_to_barycentric(surface.triangles[faces], points)
    u, v = np.einsum("ij,ijk->ki", weights, shape.uv[shape.faces[faces]])
    texture = np.asarray(image)
    columns, rows = (u * shape.texture_size).astype(int), ((1 - v) * shape.texture_size).astype(int)
    colours = texture[rows.clip(0, 511), columns.clip(0, 511)] // 43
    histogram = np.bincount(colours @ [36, 6, 1], minlength=216) / len(points)
    level = ((points[:, 2] + entry.size[2] / 2) / 0.005).astype(int)
    widths = np.zeros((2, 60))
    np.maximum.at(widths, (0, level), np.abs(points[:, 0]))
    np.maximum.at(widths, (1, level), np.abs(points[:, 1]))
    return histogram, widths


def differences(first, second):
    """Share of the surface that is of another colour, and of the outline's area that the other lacks."""
    colours = 0.5 * np.abs(first[0] - second[0]).sum()
    return colours, np.abs(first[1] - second[1]).sum() / max(first[1].sum(), second[1].sum())


def test_all_objects_look_different():
    """Any two differ by far more than one apple does from the next, which of all things here vary the most."""
    same_kind = differences(look("apple"), look("apple", seed=1))[0]
    assert 0.05 < same_kind < 0.2
    for first, second in itertools.combinations([s.id for s in HOUSEHOLD], 2):
        colours, outline = differences(look(first), look(second))
        assert colours > 1.5 * same_kind, (first, second)
        assert colours + outline > 2.5 * same_kind, (first, second)
