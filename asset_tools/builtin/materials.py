"""Textures of furniture: wood, wickerwork, tiles, plaster; patterns that close where their region repeats."""

from __future__ import annotations

import numpy as np
from PIL import Image

from asset_tools.builtin.mesh import Shape
from asset_tools.builtin.textures import Colour, Painter, blend, noise

RED = (184, 34, 30)


def _metres(shape: Shape, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates (h, w) of a region's pixels in metres: to the right, and up."""
    region = shape.regions[name]
    left, top, right, bottom = region.box
    x = (np.arange(right - left) + 0.5) / (right - left) * region.size[0]
    y = (np.arange(bottom - top)[::-1] + 0.5) / (bottom - top) * region.size[1]
    grid_x, grid_y = np.meshgrid(x, y)
    return grid_x, grid_y


def wood(x: np.ndarray, y: np.ndarray, rng: np.random.Generator, *, plank: float = 0.0) -> np.ndarray:
    """Colours (..., 3) of wood whose grain runs along y; coordinates in metres, ``plank`` the boards' width."""
    board = np.floor(x / plank) if plank else np.zeros_like(x)
    shift = board * 7.31
    bend = noise(np.stack([x * 4, y * 0.9, shift], axis=-1), rng, frequency=1.0, octaves=2)
    growth = x * 55 + 1.6 * bend + shift
    rings = 0.5 + 0.5 * np.sin(2 * np.pi * growth + 1.2 * np.sin(2 * np.pi * growth))
    fibre = noise(np.stack([x * 260, y * 7, shift], axis=-1), rng, frequency=1.0, octaves=1, waves=24)
    broad = noise(np.stack([x * 3, y * 0.8, shift], axis=-1), rng, frequency=1.0, octaves=2)
    colours = blend(0.55 * rings + 0.16 * fibre + 0.2, (206, 162, 108), (158, 106, 60))
    colours = colours * (1 + 0.07 * broad + 0.05 * np.sin(board * 12.9898))[..., None]
    if plank:
        inside = np.abs((x / plank) % 1 - 0.5) * plank  # distance from the board's middle
        colours = colours * (1 - 0.45 * np.clip((inside - plank / 2 + 0.0016) / 0.0012, 0, 1))[..., None]
    return colours


def weave(
    x: np.ndarray, y: np.ndarray, cell: tuple[float, float], rng: np.random.Generator, colour: Colour
) -> np.ndarray:
    """Colours (..., 3) of wickerwork with strands of size ``cell`` (m), alternately over and under each other."""
    i, j = np.floor(x / cell[0]), np.floor(y / cell[1])
    u, v = (x / cell[0]) % 1 - 0.5, (y / cell[1]) % 1 - 0.5
    level = (i + j) % 2 == 0
    across, along = np.where(level, v, u), np.where(level, u, v)
    shade = np.sqrt(np.clip(1 - (2 * across) ** 2, 0, 1)) * (1 - 0.4 * (2 * along) ** 4)
    strand = np.where(level, j * 12.9898, i * 78.233)
    tone = (
        1 + 0.10 * np.sin(strand * 43.7) + 0.05 * noise(np.stack([x, y, 0 * x], axis=-1), rng, frequency=120, octaves=1)
    )
    return np.asarray(colour) * ((0.34 + 0.72 * shade) * tone)[..., None]


def tiles(x: np.ndarray, y: np.ndarray, size: float, rng: np.random.Generator, period: float) -> np.ndarray:
    """Colours (..., 3) of stone tiles with joints, repeating after ``period`` (m, a multiple of ``size``)."""
    angle_x, angle_y = 2 * np.pi * x / period, 2 * np.pi * y / period
    around = np.stack([np.cos(angle_x), np.sin(angle_x), np.cos(angle_y) + 2 * np.sin(angle_y)], axis=-1)
    count = round(period / size)
    tone = rng.uniform(-1, 1, (count, count))[
        np.floor(y / size).astype(int) % count, np.floor(x / size).astype(int) % count
    ]
    stone = 0.5 + 0.25 * noise(around, rng, frequency=1.2, octaves=5) + 0.22 * tone
    colours = blend(stone, (214, 206, 194), (184, 175, 162))
    edge = np.minimum(size / 2 - np.abs(x % size - size / 2), size / 2 - np.abs(y % size - size / 2))
    return blend(np.clip((0.0045 - edge) / 0.003, 0, 1), colours, (140, 134, 126))


def plaster(
    x: np.ndarray, y: np.ndarray, rng: np.random.Generator, period: tuple[float, float], colour: Colour
) -> np.ndarray:
    """Colours (..., 3) of a painted wall, repeating after ``period`` (m)."""
    angle_x, angle_y = 2 * np.pi * x / period[0], 2 * np.pi * y / period[1]
    around = np.stack([np.cos(angle_x), np.sin(angle_x), np.cos(angle_y), np.sin(angle_y)], axis=-1)
    rough = noise(around[..., [0, 1, 2]], rng, frequency=2.0, octaves=5) + noise(
        around[..., [1, 2, 3]], rng, frequency=4.0, octaves=4
    )
    return np.asarray(colour) * (1 + 0.018 * rough)[..., None]


def paint_table(shape: Shape, rng: np.random.Generator) -> Image.Image:
    """Boards on top, plain wood elsewhere; the grain follows each part's longer side."""
    painter = Painter(shape, rng, (150, 104, 60))
    for name, region in shape.regions.items():
        x, y = _metres(shape, name)
        if name == "top":
            colours = wood(x, y, rng, plank=region.size[0] / 6)
        else:
            colours = wood(x, y, rng) if region.size[1] >= region.size[0] else wood(y, x, rng)
        painter.put(name, np.clip(colours, 0, 255).astype(np.uint8))
    return painter.image(85)


def paint_basket(shape: Shape, rng: np.random.Generator, *, height: float) -> Image.Image:
    """Red wickerwork with a plaited rim."""
    painter = Painter(shape, rng, RED)
    for name, region in shape.regions.items():
        x, y = _metres(shape, name)
        across = region.size[0]
        if name == "rim":
            slant = (x / across * 120 + y / region.size[1] * 2) % 1
            colours = np.asarray(RED) * (0.45 + 0.62 * np.sin(np.pi * slant))[..., None]
        else:
            count = 2 * round(across / 0.014 / 2)  # even, so that the pattern closes around the basket
            colours = weave(x, y, (across / count, height / 19), rng, RED)
        shade = 0.8 if name in ("inside", "floor", "bottom") else 1.0
        painter.put(name, np.clip(colours * shade, 0, 255).astype(np.uint8))
    return painter.image(85)


def paint_room(shape: Shape, rng: np.random.Generator) -> Image.Image:
    """Tiled floor, walls with a skirting board and a coloured dado, white ceiling."""
    painter = Painter(shape, rng, (230, 228, 222))
    floor, wall, ceiling = (shape.regions[name].size for name in ("floor", "wall", "ceiling"))
    x, y = _metres(shape, "floor")
    painter.put("floor", np.clip(tiles(x, y, floor[0] / 3, rng, floor[0]), 0, 255).astype(np.uint8))
    x, y = _metres(shape, "ceiling")
    painter.put("ceiling", np.clip(plaster(x, y, rng, ceiling, (236, 234, 228)), 0, 255).astype(np.uint8))
    x, y = _metres(shape, "wall")
    colours = plaster(x, y, rng, wall, (226, 218, 200))
    dado = plaster(x, y, rng, wall, (168, 184, 176))
    colours = np.where((y < 1.1)[..., None], dado, colours)
    for low, high, colour in (
        (1.08, 1.13, (240, 238, 230)),
        (0.0, 0.1, (238, 236, 230)),
        (0.1, 0.112, (150, 146, 138)),
    ):
        colours[(y >= low) & (y < high)] = colour
    painter.put("wall", np.clip(colours, 0, 255).astype(np.uint8))
    return painter.image(85)
