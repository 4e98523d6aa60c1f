"""Materials as images that tile: wood, paint, metal, stone, wickerwork.

A paint is called with a `Grid` and a generator and gives colours (h, w, 3), 0 to 255, top row first.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from asset_tools.builtin.textures import Colour, blend

Array = np.ndarray
Pair = tuple[Colour, Colour]  # light and dark

OAK: Pair = ((220, 180, 128), (168, 118, 70))
WALNUT: Pair = ((142, 98, 66), (82, 50, 32))
BEECH: Pair = ((236, 208, 168), (208, 168, 120))
RED: Colour = (184, 34, 30)


@dataclass(frozen=True)
class Grid:
    """Positions of the pixels of an image.

    Attributes:
        x: (h, w) to the right, m; the grain of wood runs this way.
        y: (h, w) upwards, m.
        size: width and height of the image, m.
    """

    x: Array
    y: Array
    size: tuple[float, float]

    @classmethod
    def of(cls, size: tuple[float, float], pixels: tuple[int, int]) -> Grid:
        """Make the grid of an image from its size in m and in pixels (width, height)."""
        right = (np.arange(pixels[0]) + 0.5) / pixels[0] * size[0]
        up = (np.arange(pixels[1])[::-1] + 0.5) / pixels[1] * size[1]
        x, y = np.meshgrid(right, up)
        return cls(x, y, size)

    def noise(self, rng: np.random.Generator, feature: tuple[float, float], *, slope: float = 2.0) -> Array:
        """Noise (h, w) of mean 0 and deviation 1 that repeats with the image.

        Args:
            rng: which noise.
            feature: size of the largest blots along x and y, m.
            slope: how fast finer detail fades: 1 is rough, 3 is smooth.
        """
        high, wide = self.x.shape
        # waves per blot
        up = np.fft.fftfreq(high)[:, None] * high / self.size[1] * feature[1]
        right = np.fft.rfftfreq(wide)[None, :] * wide / self.size[0] * feature[0]
        weight = (1 + up**2 + right**2) ** (-slope / 2)
        weight[0, 0] = 0
        result = np.fft.irfft2(np.fft.rfft2(rng.normal(size=(high, wide))) * weight, (high, wide))
        return result / result.std()

    def cells(self, cell: tuple[float, float], *, shift: float = 0.0, phase: float = 0.5) -> Cells:
        """Rows of rectangles that fit the image a whole number of times; a row of one rectangle is endless.

        Args:
            cell: width and height, m.
            shift: by how many cells each row is pushed against the one before.
            phase: offset as a fraction of a cell, so that no joint is on the border of the image.
        """
        columns, rows = (round(self.size[i] / cell[i]) for i in (0, 1))
        wide, high = self.size[0] / columns, self.size[1] / rows
        up = self.y / high + phase
        row = np.floor(up).astype(int) % rows
        along = self.x / wide + phase / 2 - (row * shift) % 1
        column = np.floor(along).astype(int) % columns
        edge = high * np.minimum(up % 1, 1 - up % 1)
        if columns > 1:
            edge = np.minimum(edge, wide * np.minimum(along % 1, 1 - along % 1))
        return Cells(row, column, edge, (rows, columns))


@dataclass(frozen=True)
class Cells:
    """The cell of each pixel: row, column, distance to its edge in m; and how many rows and columns there are."""

    row: Array
    column: Array
    edge: Array
    count: tuple[int, int]

    def random(self, rng: np.random.Generator) -> Array:
        """A number in -1 to 1 for each cell, at its pixels (h, w)."""
        return rng.uniform(-1, 1, self.count)[self.row, self.column]

    def shuffled(self, image: Array, rng: np.random.Generator) -> Array:
        """Each cell shows another place of an image that tiles."""
        down, right = (rng.integers(0, n, self.count)[self.row, self.column] for n in image.shape[:2])
        rows, columns = np.indices(image.shape[:2])
        return image[(rows + down) % image.shape[0], (columns + right) % image.shape[1]]


Paint = Callable[[Grid, np.random.Generator], Array]


@dataclass(frozen=True)
class Material:
    """A sample of a material, from which every board is cut.

    Attributes:
        size: of the sample, m, along the grain first.
        paint: its image.
        detail: how many times more pixels per metre it gets than others in the same texture.
    """

    size: tuple[float, float]
    paint: Paint
    detail: float = 1.0


def shade(colour: Array, amount: Array) -> Array:
    """Colours (..., 3) made lighter or darker by a share (h, w)."""
    return np.asarray(colour) * (1 + np.asarray(amount))[..., None]


def joint(edge: Array, width: float, soft: float = 0.0012) -> Array:
    """1 in the joint around cells, 0 within, given the distance to the edge; ``width`` is half the joint's, m."""
    return np.clip((width + soft - edge) / soft, 0, 1)


def wood(grid: Grid, rng: np.random.Generator, *, tones: Pair = OAK, plank: float = 0.0, ring: float = 0.03) -> Array:
    """Planed wood, in one piece or in planks of a width (m); ``ring`` is the distance of its growth lines, m."""
    bend = grid.noise(rng, (1.2, 0.15), slope=2.6)
    fibre = grid.noise(rng, (0.12, 0.0016), slope=1.6)
    streak = grid.noise(rng, (1.0, 0.03), slope=1.7)
    growth = (grid.y + 0.022 * bend) / ring
    late = (growth % 1) ** 2 * np.clip((1 - growth % 1) / 0.12, 0, 1)  # each year's wood grows darker, then ends
    pores = np.clip(fibre - 1.5, 0, 1.5)
    amount = 0.26 + 0.24 * late + 0.06 * fibre + 0.13 * streak + 0.20 * pores
    if plank:
        cells = grid.cells((grid.size[0], plank), phase=0.0)
        amount = cells.shuffled(amount, rng) + 0.14 * cells.random(rng)
        return shade(blend(amount, *tones), -0.5 * joint(cells.edge, 0.0007))
    return blend(amount, *tones)


def painted(grid: Grid, rng: np.random.Generator, *, colour: Colour, rough: float = 0.0015) -> Array:
    """Paint or enamel: nearly even."""
    return shade(np.broadcast_to(np.asarray(colour, float), (*grid.x.shape, 3)), rough * grid.noise(rng, (0.05, 0.05)))


def brushed(grid: Grid, rng: np.random.Generator, *, colour: Colour = (196, 198, 202)) -> Array:
    """Brushed metal, the strokes along x, lit from above."""
    strokes = grid.noise(rng, (0.08, 0.0006), slope=1.2)
    gloss = 0.16 * np.cos(2 * np.pi * grid.y / grid.size[1])
    return shade(np.broadcast_to(np.asarray(colour, float), (*grid.x.shape, 3)), 0.035 * strokes + gloss)


def marble(grid: Grid, rng: np.random.Generator) -> Array:
    """White stone with grey veins."""
    cloud = grid.noise(rng, (0.35, 0.35), slope=2.4)
    veins = np.zeros_like(cloud)
    for size, weight in ((0.5, 1.0), (0.22, 0.55)):
        field = grid.noise(rng, (size, size), slope=2.3)
        veins = np.maximum(veins, weight * np.exp(-np.abs(field) / 0.035))
    return shade(blend(0.75 * veins + 0.10 * cloud + 0.06, (240, 238, 234), (128, 130, 136)), 0.01 * cloud)


def woven(grid: Grid, rng: np.random.Generator, *, cell: tuple[float, float], colour: Colour = RED) -> Array:
    """Wickerwork with strands of a size (m), alternately over and under each other."""
    cell = (grid.size[0] / (2 * round(grid.size[0] / cell[0] / 2)), grid.size[1] / round(grid.size[1] / cell[1]))
    i, j = np.floor(grid.x / cell[0]), np.floor(grid.y / cell[1])
    u, v = (grid.x / cell[0]) % 1 - 0.5, (grid.y / cell[1]) % 1 - 0.5
    level = (i + j) % 2 == 0
    across, along = np.where(level, v, u), np.where(level, u, v)
    light = np.sqrt(np.clip(1 - (2 * across) ** 2, 0, 1)) * (1 - 0.4 * (2 * along) ** 4)
    strand = np.where(level, j * 12.9898, i * 78.233)
    tone = 1 + 0.10 * np.sin(strand * 43.7) + 0.03 * grid.noise(rng, (0.008, 0.008))
    return np.asarray(colour) * ((0.34 + 0.72 * light) * tone)[..., None]


def plaited(grid: Grid, rng: np.random.Generator, *, colour: Colour = RED, pitch: float = 0.01) -> Array:
    """A rim wound around with strands."""
    count = round(grid.size[0] / pitch)
    slant = (grid.x / grid.size[0] * count + grid.y / grid.size[1] * 2) % 1
    tone = 1 + 0.03 * grid.noise(rng, (0.008, 0.008))
    return np.asarray(colour) * ((0.45 + 0.62 * np.sin(np.pi * slant)) * tone)[..., None]


def wooden(tones: Pair, size: tuple[float, float] = (1.3, 0.42), **options: float) -> Material:
    """A sample of wood."""
    return Material(size, partial(wood, tones=tones, **options))


def coat(colour: Colour, size: tuple[float, float] = (0.3, 0.15), *, rough: float = 0.0015) -> Material:
    """A sample of paint, enamel or plastic; large things stretch it, which nobody sees."""
    return Material(size, partial(painted, colour=colour, rough=rough))


STEEL = Material((0.25, 0.1), brushed)
BLACK_STEEL = coat((46, 47, 50), rough=0.02)
WHITE = coat((236, 235, 230))
DARK = coat((58, 54, 50), rough=0.02)
