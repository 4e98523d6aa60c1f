"""Drawing label-like textures: an atlas with one canvas per region, text that fits its box, noise without seams.

Canvas coordinates are fractions of the region: x to the right, y downwards. Everything is drawn larger than the region
and reduced once, in the region's true proportions, so circles and letters stay undistorted on the object.
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
LINE_PITCH = 1.12  # of the letters' size


class Canvas:
    """One region to draw on.

    Args:
        size: of the region in metres. pixels: per metre. background: colour. rng: for noise and bar codes.
    """

    def __init__(self, size: tuple[float, float], pixels: float, background: Colour, rng: np.random.Generator) -> None:
        self.width, self.height = (max(8, round(length * pixels)) for length in size)
        self.image = Image.new("RGB", (self.width, self.height), background)
        self.draw = ImageDraw.Draw(self.image)
        self.rng = rng

    def pixels(self, box: Box) -> tuple[int, int, int, int]:
        """A box of fractions in pixels."""
        left, top, right, bottom = box
        return (
            round(left * self.width),
            round(top * self.height),
            round(right * self.width),
            round(bottom * self.height),
        )

    def rectangle(self, box: Box, colour: Colour, *, corner: float = 0.0) -> None:
        """A filled rectangle; ``corner`` is its corners' radius as a fraction of its shorter side."""
        left, top, right, bottom = self.pixels(box)
        radius = corner * min(right - left, bottom - top)
        self.draw.rounded_rectangle((left, top, right - 1, bottom - 1), radius, fill=colour)

    def disc(self, x: float, y: float, radius: float, colour: Colour, *, stretch: float = 1.0) -> None:
        """A filled circle, radius as a fraction of the height; ``stretch`` makes it wider."""
        r = radius * self.height
        x, y = x * self.width, y * self.height
        self.draw.ellipse((x - r * stretch, y - r, x + r * stretch, y + r), fill=colour)

    def polygon(self, points: list[tuple[float, float]], colour: Colour) -> None:
        """A filled polygon of (x, y) fractions."""
        self.draw.polygon([(x * self.width, y * self.height) for x, y in points], fill=colour)

    def wave(self, y: float, amplitude: float, periods: float, colour: Colour, *, bottom: float = 1.0) -> None:
        """Fill from a sine line at y down to ``bottom``; whole ``periods`` close around a cylinder."""
        x = np.linspace(0, 1, 129)
        line = y + amplitude * np.sin(2 * np.pi * periods * x)
        self.polygon([*zip(x.tolist(), line.tolist(), strict=True), (1, bottom), (0, bottom)], colour)

    def gradient(self, top: Colour, bottom: Colour) -> None:
        """Fill everything from one colour to another downwards."""
        t = np.linspace(0, 1, self.height)[:, None, None]
        rows = np.asarray(top) * (1 - t) + np.asarray(bottom) * t
        self.paste(np.broadcast_to(rows, (self.height, self.width, 3)))

    def paste(self, pixels: np.ndarray) -> None:
        """Replace everything by (height, width, 3) colours in 0..255."""
        self.image.paste(Image.fromarray(np.clip(pixels, 0, 255).astype(np.uint8)))

    def text(
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
        """Text as large as its box allows, centred in it.

        Args:
            words: may hold line breaks.
            box: where, in fractions.
            colour: of the letters.
            bold: stroke width as a fraction of the letters' size.
            turn: degrees counterclockwise, a multiple of 90.
            outline: colour around the letters.
            like: further texts that have to fit a box of this size, so that all get letters of one size.
            left_aligned: start at the box's left.
        """
        left, top, right, bottom = self.pixels(box)
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

    def barcode(self, box: Box) -> None:
        """Black bars on white."""
        self.rectangle(box, (250, 250, 250))
        left, top, right, bottom = self.pixels(box)
        margin = max(1, (right - left) // 12)
        x = left + margin
        while x < right - margin:
            bar, gap = self.rng.integers(1, 4, 2) * max(1, (right - left) // 60)
            self.draw.rectangle((x, top + margin, min(x + bar, right - margin) - 1, bottom - margin), fill=(20, 20, 20))
            x += bar + gap

    def facts(self, box: Box, title: str, rows: list[tuple[str, str]], *, ink: Colour = (25, 25, 25)) -> None:
        """A table as on the back of a package."""
        self.rectangle(box, (248, 248, 244))
        left, top, right, bottom = box
        step = (bottom - top) / (len(rows) + 1.6)
        inset = (right - left) * 0.06
        middle = left + (right - left) * 0.5
        names, amounts = (tuple(row[i] for row in rows) for i in (0, 1))
        self.text(title, (left + inset, top + step * 0.2, right - inset, top + step * 1.2), ink, bold=0.03)
        for i, (name, amount) in enumerate(rows):
            y = top + step * (1.5 + i)
            self.rectangle((left + inset, y - step * 0.08, right - inset, y - step * 0.02), ink)
            low, high = y + step * 0.12, y + step * 0.8
            self.text(name, (left + inset, low, middle, high), ink, like=names, left_aligned=True)
            self.text(amount, (middle + inset, low, right - inset, high), ink, like=amounts, left_aligned=True)


class Painter:
    """The texture of a shape, region by region.

    Args:
        shape: whose regions are painted.
        rng: source of all variation.
        background: colour where nothing is painted.
    """

    def __init__(self, shape: Shape, rng: np.random.Generator, background: Colour) -> None:
        self.shape, self.rng, self.background = shape, rng, background
        self.pixels = np.empty((shape.texture_size, shape.texture_size, 3), dtype=np.uint8)
        self.pixels[:] = background
        for name in shape.regions:
            self.fill(name, background)

    @contextmanager
    def region(self, name: str, background: Colour | None = None) -> Iterator[Canvas]:
        """A canvas for one region; it goes into the texture when the block ends."""
        region = self.shape.regions[name]
        wide, high = _box_size(region)
        pixels = OVERSAMPLING * max(wide / region.size[0], high / region.size[1])
        canvas = Canvas(region.size, pixels, background or self.background, self.rng)
        yield canvas
        self.put(name, np.asarray(canvas.image.resize((wide, high), Image.Resampling.LANCZOS)))

    def fill(self, name: str, colour: Colour) -> None:
        """One colour for a region, if the shape has it."""
        if name in self.shape.regions:
            wide, high = _box_size(self.shape.regions[name])
            self.put(name, np.full((high, wide, 3), colour, dtype=np.uint8))

    def put(self, name: str, pixels: np.ndarray) -> None:
        """(height, width, 3) pixels into a region, their border repeated into its padding."""
        left, top, right, bottom = self.shape.regions[name].box
        padded = np.pad(pixels, ((PADDING, PADDING), (PADDING, PADDING), (0, 0)), mode="edge")
        self.pixels[top - PADDING : bottom + PADDING, left - PADDING : right + PADDING] = padded

    def grid(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Angle (w,) in radians and level (h,) from 1 at the top to 0, of a region's pixels."""
        wide, high = _box_size(self.shape.regions[name])
        return np.linspace(0, 2 * np.pi, wide), np.linspace(1, 0, high)

    def image(self, quality: int = 88) -> Image.Image:
        """The texture as a JPEG image."""
        return as_jpeg(Image.fromarray(self.pixels), quality)


def as_jpeg(image: Image.Image, quality: int = 88) -> Image.Image:
    """The same image, loaded back from JPEG, so that exporters embed it as such."""
    data = io.BytesIO()
    image.convert("RGB").save(data, "JPEG", quality=quality, subsampling=0, optimize=True)
    data.seek(0)
    result = Image.open(data)
    result.load()
    return result


def noise(
    points: np.ndarray, rng: np.random.Generator, *, frequency: float, octaves: int = 3, waves: int = 12
) -> np.ndarray:
    """Smooth noise in about [-1, 1] at (..., 3) points: sums of random waves, so it has no seams.

    Args:
        points: where. rng: which noise. frequency: of the first octave, in waves per unit of length.
        octaves: each twice as fine and half as strong. waves: per octave.
    """
    result = np.zeros(points.shape[:-1])
    for octave in range(octaves):
        direction = rng.normal(size=(waves, 3))
        direction *= 2 * np.pi * frequency * 2**octave / np.linalg.norm(direction, axis=1, keepdims=True)
        phase = rng.uniform(0, 2 * np.pi, waves)
        result += np.cos(points @ direction.T + phase).sum(-1) / np.sqrt(waves / 2) / 2**octave
    return np.tanh(result / 1.6)


def blend(amount: np.ndarray | float, first: np.ndarray | Colour, second: np.ndarray | Colour) -> np.ndarray:
    """Mix two colours (..., 3): 0 gives the first, 1 the second."""
    amount = np.clip(np.asarray(amount, dtype=float), 0, 1)[..., None]
    return np.asarray(first) * (1 - amount) + np.asarray(second) * amount


def _box_size(region: Region) -> tuple[int, int]:
    left, top, right, bottom = region.box
    return right - left, bottom - top


def _extents(words: str, spread: float) -> tuple[float, float, float, float]:
    """Left, top, right, bottom of a text around its first baseline, letters of size 1, centred lines."""
    font = ImageFont.load_default(100)
    lines = words.split("\n")
    boxes = [font.getbbox(line, anchor="ls") for line in lines]
    half = max(box[2] - min(box[0], 0) for box in boxes) / 200
    top, bottom = boxes[0][1] / 100, boxes[-1][3] / 100 + LINE_PITCH * (len(lines) - 1)
    return -half - spread, top - spread, half + spread, bottom + spread


def lettering(words: str, x: np.ndarray, y: np.ndarray, height: float) -> np.ndarray:
    """Where (x, y) lie on a line of letters that is centred on 0 and ``height`` tall."""
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
