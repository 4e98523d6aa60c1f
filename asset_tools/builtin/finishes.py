"""What walls and floors are covered with: images of 2 x 2 m that tile.

Joints are soft: cameras see them from afar, and renderers without mip maps would tear sharp ones into dashes.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from asset_tools.builtin.materials import OAK, WALNUT, Array, Grid, Paint, Pair, joint, shade, wood
from asset_tools.builtin.textures import Colour, blend

TILE = 2.0  # m


def plaster(grid: Grid, rng: np.random.Generator, *, colour: Colour) -> Array:
    """A painted wall, a little uneven."""
    broad = grid.noise(rng, (0.5, 0.5), slope=2.2)
    fine = grid.noise(rng, (0.012, 0.012), slope=2.0)
    return shade(_even(grid, colour), 0.005 * broad + 0.008 * fine)


def brick(grid: Grid, rng: np.random.Generator) -> Array:
    """Red bricks in stretcher bond with light joints."""
    cells = grid.cells((TILE / 9, TILE / 26), shift=0.5)
    tone, hue = cells.random(rng), cells.random(rng)
    grit = grid.noise(rng, (0.02, 0.02), slope=2.6)
    blot = grid.noise(rng, (0.08, 0.05), slope=2.4)
    clay = blend(0.5 + 0.5 * hue, (176, 92, 68), (150, 70, 56))
    clay = shade(clay, 0.13 * tone + 0.008 * grit + 0.04 * blot)
    mortar = shade(_even(grid, (184, 174, 160)), 0.02 * grit)
    edge = cells.edge + 0.0007 * grit
    return blend(joint(edge, 0.004, 0.005), clay, mortar)


def boards(grid: Grid, rng: np.random.Generator) -> Array:
    """Upright oak boards with grooves."""
    lying = Grid.of(grid.size, (grid.x.shape[0], grid.x.shape[1]))
    cells = lying.cells((TILE, 0.125))
    amount = shade(cells.shuffled(wood(lying, rng, tones=OAK, ring=0.04), rng), 0.07 * cells.random(rng))
    return np.rot90(shade(amount, -0.40 * joint(cells.edge, 0.002, 0.006)))


def glazed(grid: Grid, rng: np.random.Generator) -> Array:
    """Glazed wall tiles of 0.2 x 0.1 m, one row pushed against the next."""
    cells = grid.cells((0.2, 0.1), shift=0.5)
    sheen = grid.noise(rng, (0.15, 0.08), slope=2.5)
    colours = shade(_even(grid, (222, 232, 230)), 0.025 * cells.random(rng) + 0.012 * sheen)
    colours = shade(colours, -0.06 * joint(cells.edge, 0.003, 0.008))
    return blend(joint(cells.edge, 0.001, 0.004), colours, (172, 178, 176))


def wallpaper(grid: Grid, rng: np.random.Generator) -> Array:
    """Stripes with sprigs of leaves."""
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
    paper = 1 + 0.008 * grid.noise(rng, (0.01, 0.01))
    return blend(0.5 * ink, colours, (104, 132, 104)) * paper[..., None]


def parquet(grid: Grid, rng: np.random.Generator, *, tones: Pair = OAK) -> Array:
    """Staves of 0.5 x 0.1 m, each row pushed on."""
    cells = grid.cells((0.5, 0.1), shift=0.35)
    plain = wood(grid, rng, tones=tones)
    colours = shade(cells.shuffled(plain, rng), 0.09 * cells.random(rng))
    return shade(colours, -0.35 * joint(cells.edge, 0.0005, 0.003))


def stone(grid: Grid, rng: np.random.Generator) -> Array:
    """Light stone tiles of 0.5 m with joints."""
    cells = grid.cells((0.5, 0.5))
    cloud = cells.shuffled(grid.noise(rng, (0.25, 0.25), slope=1.8), rng)
    colours = blend(0.5 + 0.17 * cloud + 0.18 * cells.random(rng), (216, 209, 197), (182, 173, 160))
    return blend(joint(cells.edge, 0.002, 0.004), colours, (146, 140, 132))


def terracotta(grid: Grid, rng: np.random.Generator) -> Array:
    """Square clay tiles of 0.25 m, laid in a pattern of warm tones."""
    cells = grid.cells((0.25, 0.25))
    blot = cells.shuffled(grid.noise(rng, (0.12, 0.12), slope=1.7), rng)
    clay = blend(0.5 + 0.45 * cells.random(rng), (206, 124, 84), (170, 90, 60))
    worn = 1 - 0.06 * joint(cells.edge, 0.006, 0.02)
    return blend(joint(cells.edge, 0.003, 0.004), shade(clay, 0.05 * blot) * worn[..., None], (176, 164, 150))


def concrete(grid: Grid, rng: np.random.Generator) -> Array:
    """Paint polished concrete."""
    cloud = grid.noise(rng, (0.6, 0.6), slope=1.9)
    fine = grid.noise(rng, (0.02, 0.02), slope=1.6)
    spots = np.clip(grid.noise(rng, (0.03, 0.03), slope=2.5) - 2.2, 0, 1)
    return shade(_even(grid, (156, 156, 152)), 0.032 * cloud + 0.018 * fine - 0.25 * spots)


def carpet(grid: Grid, rng: np.random.Generator) -> Array:
    """A short pile, blue-grey, flecked."""
    pile = grid.noise(rng, (0.012, 0.012), slope=2.0)
    broad = grid.noise(rng, (0.4, 0.4), slope=2.2)
    fleck = np.clip(grid.noise(rng, (0.012, 0.012), slope=2.4) - 1.5, 0, 1)
    return shade(blend(0.35 * fleck, (92, 104, 122), (178, 184, 190)), 0.042 * pile + 0.03 * broad)


def checker(grid: Grid, rng: np.random.Generator) -> Array:
    """Black and white tiles of 0.25 m."""
    cells = grid.cells((0.25, 0.25))
    cloud = cells.shuffled(grid.noise(rng, (0.2, 0.2), slope=2.0), rng)
    dark = ((cells.row + cells.column) % 2).astype(float)
    colours = shade(blend(dark, (232, 229, 222), (58, 60, 64)), 0.03 * cloud + 0.02 * cells.random(rng))
    return blend(joint(cells.edge, 0.001, 0.003), colours, (128, 126, 122))


def _even(grid: Grid, colour: Colour) -> Array:
    return np.broadcast_to(np.asarray(colour, dtype=float), (*grid.x.shape, 3))


CEILING: Paint = partial(plaster, colour=(238, 237, 232))
WALLS: dict[str, Paint] = {
    "plaster_white": partial(plaster, colour=(234, 230, 220)),
    "plaster_sage": partial(plaster, colour=(176, 192, 172)),
    "plaster_blue": partial(plaster, colour=(166, 186, 204)),
    "brick": brick,
    "wood_panel": boards,
    "tiles": glazed,
    "wallpaper": wallpaper,
}
FLOORS: dict[str, Paint] = {
    "stone_tiles": stone,  # the default: tables of wood stand out from it
    "oak_parquet": parquet,
    "walnut_parquet": partial(parquet, tones=WALNUT),
    "terracotta": terracotta,
    "concrete": concrete,
    "carpet": carpet,
    "checker": checker,
}
