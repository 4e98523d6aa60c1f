"""Paint finishes of walls and floors: images of 2 x 2 m that can be tiled.

Joints have soft edges, since renderers without mip maps would show sharp joints as dashes from far away.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from asset_tools.builtin.materials import (
    OAK,
    WALNUT,
    Array,
    Grid,
    Paint,
    Pair,
    compute_joint_mask,
    paint_wood,
    scale_brightness,
)
from asset_tools.builtin.textures import Colour, blend

TILE = 2.0  # m


def paint_plaster(grid: Grid, rng: np.random.Generator, *, colour: Colour) -> Array:
    """Paint a slightly uneven painted wall; return colours (h, w, 3) in 0..255."""
    broad = grid.make_noise(rng, (0.5, 0.5), slope=2.2)
    fine = grid.make_noise(rng, (0.012, 0.012), slope=2.0)
    return scale_brightness(_even(grid, colour), 0.005 * broad + 0.008 * fine)


def paint_bricks(grid: Grid, rng: np.random.Generator) -> Array:
    """Paint red bricks with light joints, each row shifted by half a brick.

    Return colours (h, w, 3) in 0..255.
    """
    cells = grid.make_cells((TILE / 9, TILE / 26), shift=0.5)
    tone, hue = cells.draw_random(rng), cells.draw_random(rng)
    grit = grid.make_noise(rng, (0.02, 0.02), slope=2.6)
    blot = grid.make_noise(rng, (0.08, 0.05), slope=2.4)
    clay = blend(0.5 + 0.5 * hue, (176, 92, 68), (150, 70, 56))
    clay = scale_brightness(clay, 0.13 * tone + 0.008 * grit + 0.04 * blot)
    mortar = scale_brightness(_even(grid, (184, 174, 160)), 0.02 * grit)
    edge = cells.edge + 0.0007 * grit
    return blend(compute_joint_mask(edge, 0.004, 0.005), clay, mortar)


def paint_boards(grid: Grid, rng: np.random.Generator) -> Array:
    """Paint vertical oak boards with grooves; return colours (h, w, 3) in 0..255."""
    lying = Grid.from_size(grid.size, (grid.x.shape[0], grid.x.shape[1]))
    cells = lying.make_cells((TILE, 0.125))
    amount = scale_brightness(
        cells.shuffle_image(paint_wood(lying, rng, tones=OAK, ring=0.04), rng), 0.07 * cells.draw_random(rng)
    )
    return np.rot90(scale_brightness(amount, -0.40 * compute_joint_mask(cells.edge, 0.002, 0.006)))


def paint_glazed_tiles(grid: Grid, rng: np.random.Generator) -> Array:
    """Paint glazed tiles of 0.2 x 0.1 m, each row shifted by half a tile.

    Return colours (h, w, 3) in 0..255.
    """
    cells = grid.make_cells((0.2, 0.1), shift=0.5)
    sheen = grid.make_noise(rng, (0.15, 0.08), slope=2.5)
    colours = scale_brightness(_even(grid, (222, 232, 230)), 0.025 * cells.draw_random(rng) + 0.012 * sheen)
    colours = scale_brightness(colours, -0.06 * compute_joint_mask(cells.edge, 0.003, 0.008))
    return blend(compute_joint_mask(cells.edge, 0.001, 0.004), colours, (172, 178, 176))


def paint_wallpaper(grid: Grid, rng: np.random.Generator) -> Array:
    """Paint wallpaper with stripes and leaves; return colours (h, w, 3) in 0..255."""
    pitch = TILE / 8
    stripe = 0.5 + 0.5 * np.tanh(6 * np.cos(2 * np.pi * grid.x / pitch))
    colours = blend(stripe, (222, 210, 184), (236, 228, 208))
    u = grid.x % pitch / pitch - 0.5
    v = (grid.y / pitch + 0.5 * (np.floor(grid.x / pitch) % 2)) % 1 - 0.5
    ink = np.zeros_like(u)
    ink = np.maximum(ink, (np.abs(u) < 0.012) & (np.abs(v) < 0.24))
    for height in (-0.16, -0.04, 0.08):
        for side in (-1, 1):  # leaves that point up and outwards
            along = (u * side * 0.707 + (v - height) * 0.707) / 0.085 - 1
            across = (-u * side * 0.707 + (v - height) * 0.707) / 0.034
            ink = np.maximum(ink, along**2 + across**2 < 1)
    ink = np.maximum(ink, (u / 0.035) ** 2 + ((v - 0.27) / 0.055) ** 2 < 1)
    paper = 1 + 0.008 * grid.make_noise(rng, (0.01, 0.01))
    return blend(0.5 * ink, colours, (104, 132, 104)) * paper[..., None]


def paint_parquet(grid: Grid, rng: np.random.Generator, *, tones: Pair = OAK) -> Array:
    """Paint parquet of staves of 0.5 x 0.1 m in shifted rows; return colours (h, w, 3) in 0..255."""
    cells = grid.make_cells((0.5, 0.1), shift=0.35)
    plain = paint_wood(grid, rng, tones=tones)
    colours = scale_brightness(cells.shuffle_image(plain, rng), 0.09 * cells.draw_random(rng))
    return scale_brightness(colours, -0.35 * compute_joint_mask(cells.edge, 0.0005, 0.003))


def paint_stone_tiles(grid: Grid, rng: np.random.Generator) -> Array:
    """Paint light stone tiles of 0.5 m; return colours (h, w, 3) in 0..255."""
    cells = grid.make_cells((0.5, 0.5))
    cloud = cells.shuffle_image(grid.make_noise(rng, (0.25, 0.25), slope=1.8), rng)
    colours = blend(0.5 + 0.17 * cloud + 0.18 * cells.draw_random(rng), (216, 209, 197), (182, 173, 160))
    return blend(compute_joint_mask(cells.edge, 0.002, 0.004), colours, (146, 140, 132))


def paint_terracotta(grid: Grid, rng: np.random.Generator) -> Array:
    """Paint square clay tiles of 0.25 m in warm colours; return colours (h, w, 3) in 0..255."""
    cells = grid.make_cells((0.25, 0.25))
    blot = cells.shuffle_image(grid.make_noise(rng, (0.12, 0.12), slope=1.7), rng)
    clay = blend(0.5 + 0.45 * cells.draw_random(rng), (206, 124, 84), (170, 90, 60))
    worn = 1 - 0.06 * compute_joint_mask(cells.edge, 0.006, 0.02)
    return blend(
        compute_joint_mask(cells.edge, 0.003, 0.004),
        scale_brightness(clay, 0.05 * blot) * worn[..., None],
        (176, 164, 150),
    )


def paint_concrete(grid: Grid, rng: np.random.Generator) -> Array:
    """Paint polished concrete; return colours (h, w, 3) in 0..255."""
    cloud = grid.make_noise(rng, (0.6, 0.6), slope=1.9)
    fine = grid.make_noise(rng, (0.02, 0.02), slope=1.6)
    spots = np.clip(grid.make_noise(rng, (0.03, 0.03), slope=2.5) - 2.2, 0, 1)
    return scale_brightness(_even(grid, (156, 156, 152)), 0.032 * cloud + 0.018 * fine - 0.25 * spots)


def paint_carpet(grid: Grid, rng: np.random.Generator) -> Array:
    """Paint a blue-grey carpet with light flecks; return colours (h, w, 3) in 0..255."""
    pile = grid.make_noise(rng, (0.012, 0.012), slope=2.0)
    broad = grid.make_noise(rng, (0.4, 0.4), slope=2.2)
    fleck = np.clip(grid.make_noise(rng, (0.012, 0.012), slope=2.4) - 1.5, 0, 1)
    return scale_brightness(blend(0.35 * fleck, (92, 104, 122), (178, 184, 190)), 0.042 * pile + 0.03 * broad)


def paint_checkered_tiles(grid: Grid, rng: np.random.Generator) -> Array:
    """Paint black and white tiles of 0.25 m; return colours (h, w, 3) in 0..255."""
    cells = grid.make_cells((0.25, 0.25))
    cloud = cells.shuffle_image(grid.make_noise(rng, (0.2, 0.2), slope=2.0), rng)
    dark = ((cells.row + cells.column) % 2).astype(float)
    colours = scale_brightness(blend(dark, (232, 229, 222), (58, 60, 64)), 0.03 * cloud + 0.02 * cells.draw_random(rng))
    return blend(compute_joint_mask(cells.edge, 0.001, 0.003), colours, (128, 126, 122))


def _even(grid: Grid, colour: Colour) -> Array:
    return np.broadcast_to(np.asarray(colour, dtype=float), (*grid.x.shape, 3))


CEILING: Paint = partial(paint_plaster, colour=(238, 237, 232))
WALLS: dict[str, Paint] = {
    "plaster_white": partial(paint_plaster, colour=(234, 230, 220)),
    "plaster_sage": partial(paint_plaster, colour=(176, 192, 172)),
    "plaster_blue": partial(paint_plaster, colour=(166, 186, 204)),
    "brick": paint_bricks,
    "wood_panel": paint_boards,
    "tiles": paint_glazed_tiles,
    "wallpaper": paint_wallpaper,
}
FLOORS: dict[str, Paint] = {
    "stone_tiles": paint_stone_tiles,  # the default, since wooden tables are easy to see on it
    "oak_parquet": paint_parquet,
    "walnut_parquet": partial(paint_parquet, tones=WALNUT),
    "terracotta": paint_terracotta,
    "concrete": paint_concrete,
    "carpet": paint_carpet,
    "checker": paint_checkered_tiles,
}
