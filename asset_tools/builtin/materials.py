"""Paint images of materials that can be tiled: wood, paint, metal, stone, wickerwork.

A paint function gets a `Grid` and a random generator. It returns colours (h, w, 3) in 0..255, with the top row first.
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
    """Positions of the pixels of an image on the surface.

    Attributes:
        x: (h, w) positions to the right, m; the grain of wood has this direction.
        y: (h, w) positions upwards, m.
        size: width and height of the image, m.
    """

    x: Array
    y: Array
    size: tuple[float, float]

    @classmethod
    def from_size(cls, size: tuple[float, float], pixels: tuple[int, int]) -> Grid:
        """Return the grid of an image, given its width and height in m and in pixels."""
        right = (np.arange(pixels[0]) + 0.5) / pixels[0] * size[0]
        up = (np.arange(pixels[1])[::-1] + 0.5) / pixels[1] * size[1]
        x, y = np.meshgrid(right, up)
        return cls(x, y, size)

    def make_noise(self, rng: np.random.Generator, feature: tuple[float, float], *, slope: float = 2.0) -> Array:
        """Return noise (h, w) with mean 0 and standard deviation 1 that continues when the image is tiled.

        Args:
            rng: random generator.
            feature: size of the largest features along x and y, m.
            slope: exponent with which finer features get weaker: 1 is rough, 3 is smooth.
        """
        high, wide = self.x.shape
        # waves per feature
        up = np.fft.fftfreq(high)[:, None] * high / self.size[1] * feature[1]
        right = np.fft.rfftfreq(wide)[None, :] * wide / self.size[0] * feature[0]
        weight = (1 + up**2 + right**2) ** (-slope / 2)
        weight[0, 0] = 0
        result = np.fft.irfft2(np.fft.rfft2(rng.normal(size=(high, wide))) * weight, (high, wide))
        return result / result.std()

    def make_cells(self, cell: tuple[float, float], *, shift: float = 0.0, phase: float = 0.5) -> Cells:
        """Divide the image into rows of equal rectangles, such as tiles or bricks.

        If a row has only one rectangle, the rectangle has no left and right edge.

        Args:
            cell: approximate width and height of a rectangle, m.
            shift: shift of each row relative to the previous row, as a fraction of a rectangle.
            phase: offset as a fraction of a rectangle, so that no joint is at the border of the image.
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
    """Rectangles of an image, such as tiles or bricks.

    Attributes:
        row: (h, w) row of the rectangle at each pixel.
        column: (h, w) column of the rectangle at each pixel.
        edge: (h, w) distance of each pixel from the edge of its rectangle, m.
        count: number of rows and columns.
    """

    row: Array
    column: Array
    edge: Array
    count: tuple[int, int]

    def draw_random(self, rng: np.random.Generator) -> Array:
        """Return at each pixel (h, w) a random number in -1..1 that is equal within a rectangle."""
        return rng.uniform(-1, 1, self.count)[self.row, self.column]

    def shuffle_image(self, image: Array, rng: np.random.Generator) -> Array:
        """Return an image in which each rectangle shows another random place of ``image``, which can be tiled."""
        down, right = (rng.integers(0, n, self.count)[self.row, self.column] for n in image.shape[:2])
        rows, columns = np.indices(image.shape[:2])
        return image[(rows + down) % image.shape[0], (columns + right) % image.shape[1]]


Paint = Callable[[Grid, np.random.Generator], Array]


@dataclass(frozen=True)
class Material:
    """A sample of a material: an image from which the textures of all boards are cut.

    Attributes:
        size: size of the sample along the grain and across, m.
        paint: function that paints the image.
        detail: factor of the number of pixels per metre.
    """

    size: tuple[float, float]
    paint: Paint
    detail: float = 1.0


def scale_brightness(colour: Array, amount: Array) -> Array:
    """Return colours (..., 3) whose brightness is increased by a fraction (...); negative: decreased."""
    return np.asarray(colour) * (1 + np.asarray(amount))[..., None]


def compute_joint_mask(edge: Array, width: float, soft: float = 0.0012) -> Array:
    """Return a mask (h, w) that is 1 in the joints between rectangles and 0 inside of them.

    Args:
        edge: (h, w) distance of each pixel from the edge of its rectangle, m.
        width: half of the width of a joint, m.
        soft: width of the transition from 1 to 0, m.
    """
    return np.clip((width + soft - edge) / soft, 0, 1)


def paint_wood(
    grid: Grid, rng: np.random.Generator, *, tones: Pair = OAK, plank: float = 0.0, ring: float = 0.03
) -> Array:
    """Paint smooth wood; return colours (h, w, 3) in 0..255.

    Args:
        grid: positions of the pixels.
        rng: random generator.
        tones: light and dark colour.
        plank: width of the planks, m; 0: one piece.
        ring: distance of the growth rings, m.
    """
    bend = grid.make_noise(rng, (1.2, 0.15), slope=2.6)
    fibre = grid.make_noise(rng, (0.12, 0.0016), slope=1.6)
    streak = grid.make_noise(rng, (1.0, 0.03), slope=1.7)
    growth = (grid.y + 0.022 * bend) / ring
    late = (growth % 1) ** 2 * np.clip((1 - growth % 1) / 0.12, 0, 1)  # the wood of each year becomes darker, then ends
    pores = np.clip(fibre - 1.5, 0, 1.5)
    amount = 0.26 + 0.24 * late + 0.06 * fibre + 0.13 * streak + 0.20 * pores
    if plank:
        cells = grid.make_cells((grid.size[0], plank), phase=0.0)
        amount = cells.shuffle_image(amount, rng) + 0.14 * cells.draw_random(rng)
        return scale_brightness(blend(amount, *tones), -0.5 * compute_joint_mask(cells.edge, 0.0007))
    return blend(amount, *tones)


def paint_plain(grid: Grid, rng: np.random.Generator, *, colour: Colour, rough: float = 0.0015) -> Array:
    """Paint a surface of one colour with slight variations; return colours (h, w, 3) in 0..255."""
    return scale_brightness(
        np.broadcast_to(np.asarray(colour, float), (*grid.x.shape, 3)), rough * grid.make_noise(rng, (0.05, 0.05))
    )


def paint_brushed_metal(grid: Grid, rng: np.random.Generator, *, colour: Colour = (196, 198, 202)) -> Array:
    """Paint brushed metal with strokes along x and light from above.

    Return colours (h, w, 3) in 0..255.
    """
    strokes = grid.make_noise(rng, (0.08, 0.0006), slope=1.2)
    gloss = 0.16 * np.cos(2 * np.pi * grid.y / grid.size[1])
    return scale_brightness(np.broadcast_to(np.asarray(colour, float), (*grid.x.shape, 3)), 0.035 * strokes + gloss)


def paint_marble(grid: Grid, rng: np.random.Generator) -> Array:
    """Paint white stone with grey veins; return colours (h, w, 3) in 0..255."""
    cloud = grid.make_noise(rng, (0.35, 0.35), slope=2.4)
    veins = np.zeros_like(cloud)
    for size, weight in ((0.5, 1.0), (0.22, 0.55)):
        field = grid.make_noise(rng, (size, size), slope=2.3)
        veins = np.maximum(veins, weight * np.exp(-np.abs(field) / 0.035))
    return scale_brightness(blend(0.75 * veins + 0.10 * cloud + 0.06, (240, 238, 234), (128, 130, 136)), 0.01 * cloud)


def paint_wickerwork(grid: Grid, rng: np.random.Generator, *, cell: tuple[float, float], colour: Colour = RED) -> Array:
    """Paint wickerwork, whose strands cross over and under each other; return colours (h, w, 3) in 0..255.

    Args:
        grid: positions of the pixels.
        rng: random generator.
        cell: width and height of the visible part of a strand, m.
        colour: colour of the strands.
    """
    cell = (grid.size[0] / (2 * round(grid.size[0] / cell[0] / 2)), grid.size[1] / round(grid.size[1] / cell[1]))
    i, j = np.floor(grid.x / cell[0]), np.floor(grid.y / cell[1])
    u, v = (grid.x / cell[0]) % 1 - 0.5, (grid.y / cell[1]) % 1 - 0.5
    level = (i + j) % 2 == 0
    across, along = np.where(level, v, u), np.where(level, u, v)
    light = np.sqrt(np.clip(1 - (2 * across) ** 2, 0, 1)) * (1 - 0.4 * (2 * along) ** 4)
    strand = np.where(level, j * 12.9898, i * 78.233)
    tone = 1 + 0.10 * np.sin(strand * 43.7) + 0.03 * grid.make_noise(rng, (0.008, 0.008))
    return np.asarray(colour) * ((0.34 + 0.72 * light) * tone)[..., None]


def paint_wrapped_rim(grid: Grid, rng: np.random.Generator, *, colour: Colour = RED, pitch: float = 0.01) -> Array:
    """Paint a rim that is wrapped with strands ``pitch`` m wide; return colours (h, w, 3) in 0..255."""
    count = round(grid.size[0] / pitch)
    slant = (grid.x / grid.size[0] * count + grid.y / grid.size[1] * 2) % 1
    tone = 1 + 0.03 * grid.make_noise(rng, (0.008, 0.008))
    return np.asarray(colour) * ((0.45 + 0.62 * np.sin(np.pi * slant)) * tone)[..., None]


def make_wood(tones: Pair, size: tuple[float, float] = (1.3, 0.42), **options: float) -> Material:
    """Return a sample of wood with a light and a dark colour; ``options`` as in `paint_wood`."""
    return Material(size, partial(paint_wood, tones=tones, **options))


def make_coating(colour: Colour, size: tuple[float, float] = (0.3, 0.15), *, rough: float = 0.0015) -> Material:
    """Return a sample of paint, enamel or plastic, which is stretched on larger surfaces."""
    return Material(size, partial(paint_plain, colour=colour, rough=rough))


STEEL = Material((0.25, 0.1), paint_brushed_metal)
BLACK_STEEL = make_coating((46, 47, 50), rough=0.02)
WHITE = make_coating((236, 235, 230))
DARK = make_coating((58, 54, 50), rough=0.02)
