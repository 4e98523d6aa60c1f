"""Draw textures of packages: a canvas per region, text that fits in a box, noise without seams.

Canvas coordinates are fractions of the region: x to the right, y downwards. A canvas has the proportions of the region
on the object, so circles and letters are not distorted. It is larger than the region and is reduced at the end.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from pydantic import Field

from asset_tools.builtin.mesh import PADDING, Region, Shape

Channel = Annotated[int, Field(ge=0, le=255)]
Colour = tuple[Channel, Channel, Channel]
Box = tuple[float, float, float, float]

OVERSAMPLING = 2.0
LINE_PITCH = 1.12  # line spacing over size of the letters


class Canvas:
    """Canvas for one region of a texture.

    Args:
        size: width and height of the region, m.
        pixels: pixels per metre.
        background: initial colour.
        rng: random generator for noise and bar codes.
    """

    def __init__(self, size: tuple[float, float], pixels: float, background: Colour, rng: np.random.Generator) -> None:
        self.width, self.height = (max(8, round(length * pixels)) for length in size)
        self.image = Image.new("RGB", (self.width, self.height), background)
        self.draw = ImageDraw.Draw(self.image)
        self.rng = rng

    def to_pixels(self, box: Box) -> tuple[int, int, int, int]:
        """Convert a box (left, top, right, bottom) from fractions to pixels."""
        left, top, right, bottom = box
        return (
            round(left * self.width),
            round(top * self.height),
            round(right * self.width),
            round(bottom * self.height),
        )

    def draw_rectangle(self, box: Box, colour: Colour, *, corner: float = 0.0) -> None:
        """Draw a filled rectangle; ``corner`` is the radius of its corners as a fraction of the shorter side."""
        left, top, right, bottom = self.to_pixels(box)
        radius = corner * min(right - left, bottom - top)
        self.draw.rounded_rectangle((left, top, right - 1, bottom - 1), radius, fill=colour)

    def draw_disc(self, x: float, y: float, radius: float, colour: Colour, *, stretch: float = 1.0) -> None:
        """Draw a filled circle; ``radius`` is a fraction of the height, and ``stretch`` a factor of the width."""
        r = radius * self.height
        x, y = x * self.width, y * self.height
        self.draw.ellipse((x - r * stretch, y - r, x + r * stretch, y + r), fill=colour)

    def draw_polygon(self, points: list[tuple[float, float]], colour: Colour) -> None:
        """Draw a filled polygon with corners (x, y) in fractions."""
        self.draw.polygon([(x * self.width, y * self.height) for x, y in points], fill=colour)

    def fill_wave(self, y: float, amplitude: float, periods: float, colour: Colour, *, bottom: float = 1.0) -> None:
        """Fill the area between a sine wave at ``y`` and ``bottom``.

        If ``periods`` is a whole number, the wave continues at the seam of a cylinder.
        """
        x = np.linspace(0, 1, 129)
        line = y + amplitude * np.sin(2 * np.pi * periods * x)
        self.draw_polygon([*zip(x.tolist(), line.tolist(), strict=True), (1, bottom), (0, bottom)], colour)

    def fill_gradient(self, top: Colour, bottom: Colour) -> None:
        """Fill the canvas with a gradient from the colour ``top`` to the colour ``bottom``."""
        t = np.linspace(0, 1, self.height)[:, None, None]
        rows = np.asarray(top) * (1 - t) + np.asarray(bottom) * t
        self.paste(np.broadcast_to(rows, (self.height, self.width, 3)))

    def paste(self, pixels: np.ndarray) -> None:
        """Replace the content of the canvas by colours (height, width, 3) in 0..255."""
        self.image.paste(Image.fromarray(np.clip(pixels, 0, 255).astype(np.uint8)))

    def draw_text(
        self,
        words: str,
        box: Box,
        colour: Colour,
        *,
        bold: float = 0.0,
        turn: int = 0,
        outline: Colour | None = None,
        like: tuple[str, ...] = (),
        left_aligned: bool = False,
    ) -> None:
        """Draw a text in the centre of a box, as large as the box allows.

        Args:
            words: the text, with or without line breaks.
            box: left, top, right and bottom of the box, fractions.
            colour: colour of the letters.
            bold: width of an additional stroke around the letters, as a fraction of their size.
            turn: rotation in degrees counterclockwise, a multiple of 90.
            outline: colour of an outline around the letters; None: no outline.
            like: other texts for boxes of this size. The letters are so small that these texts also fit.
            left_aligned: whether lines start at the left side of the box.
        """
        left, top, right, bottom = self.to_pixels(box)
        wide, high = (bottom - top, right - left) if turn % 180 else (right - left, bottom - top)
        wide, high = max(wide, 4), max(high, 4)
        spread = bold + (0.05 if outline else 0.0)
        extents = [_extents(text, spread) for text in (words, *like)]
        size = min(min(wide / (x1 - x0), high / (y1 - y0)) for x0, y0, x1, y1 in extents) * 0.98
        y0, y1 = size * extents[0][1], size * extents[0][3]
        first = (high - y0 - y1) / 2
        font = ImageFont.load_default(size)
        mask = Image.new("L", (wide, high))
        pen = ImageDraw.Draw(mask)
        for ink, stroke in ((outline, bold * size + 0.05 * size), (colour, bold * size)):
            if ink is None:
                continue
            mask.paste(0, (0, 0, wide, high))
            for i, line in enumerate(words.split("\n")):
                anchor, x = ("ls", bold * size) if left_aligned else ("ms", wide / 2)
                pen.text((x, first + i * LINE_PITCH * size), line, 255, font, anchor=anchor, stroke_width=round(stroke))
            self.image.paste(ink, (left, top), mask.rotate(turn, expand=True))

    def draw_barcode(self, box: Box) -> None:
        """Draw a bar code: black bars on white."""
        self.draw_rectangle(box, (250, 250, 250))
        left, top, right, bottom = self.to_pixels(box)
        margin = max(1, (right - left) // 12)
        x = left + margin
        while x < right - margin:
            bar, gap = self.rng.integers(1, 4, 2) * max(1, (right - left) // 60)
            self.draw.rectangle((x, top + margin, min(x + bar, right - margin) - 1, bottom - margin), fill=(20, 20, 20))
            x += bar + gap

    def draw_table(self, box: Box, title: str, rows: list[tuple[str, str]], *, ink: Colour = (25, 25, 25)) -> None:
        """Draw a table with a title and rows (name, amount), as on the back of a package."""
        self.draw_rectangle(box, (248, 248, 244))
        left, top, right, bottom = box
        step = (bottom - top) / (len(rows) + 1.6)
        inset = (right - left) * 0.06
        middle = left + (right - left) * 0.5
        names, amounts = (tuple(row[i] for row in rows) for i in (0, 1))
        self.draw_text(title, (left + inset, top + step * 0.2, right - inset, top + step * 1.2), ink, bold=0.03)
        for i, (name, amount) in enumerate(rows):
            y = top + step * (1.5 + i)
            self.draw_rectangle((left + inset, y - step * 0.08, right - inset, y - step * 0.02), ink)
            low, high = y + step * 0.12, y + step * 0.8
            self.draw_text(name, (left + inset, low, middle, high), ink, like=names, left_aligned=True)
            self.draw_text(amount, (middle + inset, low, right - inset, high), ink, like=amounts, left_aligned=True)


class Painter:
    """Texture of a shape that is painted region by region.

    Args:
        shape: shape with regions.
        rng: random generator for all variations.
        background: initial colour of the texture.
    """

    def __init__(self, shape: Shape, rng: np.random.Generator, background: Colour) -> None:
        self.shape, self.rng, self.background = shape, rng, background
        self.pixels = np.empty((shape.texture_size, shape.texture_size, 3), dtype=np.uint8)
        self.pixels[:] = background
        for name in shape.regions:
            self.fill_region(name, background)

    @contextmanager
    def open_region(self, name: str, background: Colour | None = None) -> Iterator[Canvas]:
        """Return a canvas for one region as a context manager; the canvas is copied to the texture at the end."""
        region = self.shape.regions[name]
        wide, high = _box_size(region)
        pixels = OVERSAMPLING * max(wide / region.size[0], high / region.size[1])
        canvas = Canvas(region.size, pixels, background or self.background, self.rng)
        yield canvas
        self.put_pixels(name, np.asarray(canvas.image.resize((wide, high), Image.Resampling.LANCZOS)))

    def fill_region(self, name: str, colour: Colour) -> None:
        """Fill a region with one colour; do nothing if the shape has no such region."""
        if name in self.shape.regions:
            wide, high = _box_size(self.shape.regions[name])
            self.put_pixels(name, np.full((high, wide, 3), colour, dtype=np.uint8))

    def put_pixels(self, name: str, pixels: np.ndarray) -> None:
        """Copy pixels (height, width, 3) to a region, and their border to the padding around the region."""
        left, top, right, bottom = self.shape.regions[name].box
        padded = np.pad(pixels, ((PADDING, PADDING), (PADDING, PADDING), (0, 0)), mode="edge")
        self.pixels[top - PADDING : bottom + PADDING, left - PADDING : right + PADDING] = padded

    def compute_grid(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return the angle (w,) in radians and the level (h,), 1 at the top to 0, of the pixels of a region."""
        wide, high = _box_size(self.shape.regions[name])
        return np.linspace(0, 2 * np.pi, wide), np.linspace(1, 0, high)

    def make_image(self, quality: int = 88) -> Image.Image:
        """Return the texture as an image that is stored as JPEG with a quality in percent."""
        return encode_jpeg(Image.fromarray(self.pixels), quality)


def encode_jpeg(image: Image.Image, quality: int = 88) -> Image.Image:
    """Encode an image as JPEG and return the decoded image, so that exporters embed a JPEG file."""
    data = io.BytesIO()
    image.convert("RGB").save(data, "JPEG", quality=quality, subsampling=0, optimize=True)
    data.seek(0)
    result = Image.open(data)
    result.load()
    return result


def compute_noise(
    points: np.ndarray, rng: np.random.Generator, *, frequency: float, octaves: int = 3, waves: int = 12
) -> np.ndarray:
    """Return smooth noise (...) in about [-1, 1] at points, a sum of random waves in space.

    Args:
        points: (..., 3) points.
        rng: random generator.
        frequency: waves per unit of length in the first octave.
        octaves: number of octaves; each octave has twice the frequency and half the amplitude of the previous octave.
        waves: number of waves per octave.
    """
    result = np.zeros(points.shape[:-1])
    for octave in range(octaves):
        direction = rng.normal(size=(waves, 3))
        direction *= 2 * np.pi * frequency * 2**octave / np.linalg.norm(direction, axis=1, keepdims=True)
        phase = rng.uniform(0, 2 * np.pi, waves)
        result += np.cos(points @ direction.T + phase).sum(-1) / np.sqrt(waves / 2) / 2**octave
    return np.tanh(result / 1.6)


def blend(amount: np.ndarray | float, first: np.ndarray | Colour, second: np.ndarray | Colour) -> np.ndarray:
    """Mix two colours (..., 3); the amount (...) is 0 for the first colour and 1 for the second colour."""
    amount = np.clip(np.asarray(amount, dtype=float), 0, 1)[..., None]
    return np.asarray(first) * (1 - amount) + np.asarray(second) * amount


def _box_size(region: Region) -> tuple[int, int]:
    left, top, right, bottom = region.box
    return right - left, bottom - top


def _extents(words: str, spread: float) -> tuple[float, float, float, float]:
    """Return left, top, right and bottom of a text with letters of size 1 and centred lines.

    The origin is on the first baseline. ``spread`` is added at all sides.
    """
    font = ImageFont.load_default(100)
    lines = words.split("\n")
    boxes = [font.getbbox(line, anchor="ls") for line in lines]
    half = max(box[2] - min(box[0], 0) for box in boxes) / 200
    top, bottom = boxes[0][1] / 100, boxes[-1][3] / 100 + LINE_PITCH * (len(lines) - 1)
    return -half - spread, top - spread, half + spread, bottom + spread


def compute_text_mask(words: str, x: np.ndarray, y: np.ndarray, height: float) -> np.ndarray:
    """Return a mask (n,) of the points on the letters of a text that is centred at 0, ``height`` tall."""
    font = ImageFont.load_default(64)
    left, top, right, bottom = (round(v) for v in font.getbbox(words, stroke_width=2))
    image = Image.new("L", (right - left, bottom - top))
    ImageDraw.Draw(image).text((-left, -top), words, 255, font, stroke_width=2)
    pixels = np.asarray(image)
    scale = pixels.shape[0] / height
    column = np.rint(x * scale + pixels.shape[1] / 2).astype(int)
    row = np.rint(pixels.shape[0] / 2 - y * scale).astype(int)
    inside = (column >= 0) & (column < pixels.shape[1]) & (row >= 0) & (row < pixels.shape[0])
    result = np.zeros(len(x), bool)
    result[inside] = pixels[row[inside], column[inside]] > 127
    return result
