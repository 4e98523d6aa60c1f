"""Paint the skins of fruits; colours are functions of the position in space, so they have no seams."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from PIL import Image

from asset_tools.builtin.mesh import Shape
from asset_tools.builtin.textures import Colour, Painter, blend, compute_noise


@dataclass(frozen=True, kw_only=True)
class Fruit:
    """Colours of the skin and the stem of a round fruit. A colour that is None is not used.

    Attributes:
        base: main colour.
        blush: colour of the sunny side.
        blush_amount: fraction of the surface with the colour ``blush``.
        streaks: strength of lines of the colour ``blush`` from the stem to the bottom.
        poles: colour around the stem and the bottom.
        crown: colour of a wide, irregular patch around the stem.
        speckle: colour of small dots.
        pores: amplitude of fine dimples, as a fraction of the brightness.
        bloom: colour of an irregular film of wax or fuzz.
        groove: fraction by which the groove along the front is darker.
        stem: colour of the stem.
    """

    base: Colour
    blush: Colour
    blush_amount: float = 0.5
    streaks: float = 0.0
    poles: Colour | None = None
    crown: Colour | None = None
    speckle: Colour | None = None
    pores: float = 0.0
    bloom: Colour | None = None
    groove: float = 0.0
    stem: Colour = (92, 62, 34)

    def __call__(self, shape: Shape, rng: np.random.Generator) -> Image.Image:
        """Return the texture of a shape with the region ``skin``."""
        painter = Painter(shape, rng, self.base)
        angle, level = painter.compute_grid("skin")
        polar = np.pi * (1 - level)[:, None]
        points = np.stack(
            np.broadcast_arrays(np.sin(polar) * np.cos(angle), np.sin(polar) * np.sin(angle), np.cos(polar)), axis=-1
        )
        side = points @ np.array([0.5, -0.8, 0.3])
        amount = self.blush_amount - 0.5 + 0.55 * side + 0.35 * compute_noise(points, rng, frequency=0.5)
        if self.streaks:
            lines = points * np.array([1.0, 1.0, 0.12]) / np.maximum(np.sin(polar), 0.15)[..., None]
            amount = amount + self.streaks * compute_noise(lines, rng, frequency=3.0, octaves=4)
        colours = blend(1 / (1 + np.exp(-5 * amount)), self.base, self.blush)
        if self.poles:
            cap = np.exp(-(((1 - np.abs(points[..., 2])) / 0.09) ** 2))
            colours = blend(cap * (0.8 + 0.2 * compute_noise(points, rng, frequency=2.0)), colours, self.poles)
        if self.crown:
            ragged = 0.22 * compute_noise(points, rng, frequency=1.2)
            colours = blend(0.9 / (1 + np.exp(-9 * (points[..., 2] - 0.72 + ragged))), colours, self.crown)
        if self.bloom:
            film = (
                0.55
                + 0.6 * compute_noise(points, rng, frequency=1.1)
                + 0.25 * compute_noise(points, rng, frequency=8.0, octaves=1, waves=30)
            )
            colours = blend(np.clip(0.42 * film, 0, 0.6), colours, self.bloom)
        if self.groove:
            off_front = np.angle(np.exp(1j * (angle - np.pi)))[None, :]
            colours = colours * (1 - self.groove * np.exp(-((off_front / 0.09) ** 2)) * np.sin(polar))[..., None]
        if self.speckle:
            spots = compute_noise(points, rng, frequency=9.0, octaves=1, waves=40)
            colours = blend(np.clip(6 * (spots - 0.72), 0, 0.75), colours, self.speckle)
        if self.pores:
            colours = (
                colours * (1 + self.pores * compute_noise(points, rng, frequency=14.0, octaves=2, waves=40))[..., None]
            )
        colours = colours * (1 + 0.05 * compute_noise(points, rng, frequency=1.5))[..., None]
        painter.put_pixels("skin", np.clip(colours, 0, 255).astype(np.uint8))
        painter.fill_region("stem", self.stem)
        return painter.make_image()


def paint_banana(shape: Shape, rng: np.random.Generator) -> Image.Image:
    """Paint a banana: yellow, greenish at the ends, with a brown stem, tip, edges and freckles."""
    painter = Painter(shape, rng, (236, 200, 60))
    angle, level = painter.compute_grid("skin")
    from_stem = level[:, None]  # the bottom of the region is the start of the sweep: the stem
    points = np.stack(np.broadcast_arrays(np.cos(angle), np.sin(angle), 9 * from_stem), axis=-1)
    ends = np.clip((np.abs(from_stem - 0.5) - 0.24) / 0.2, 0, 1)
    colours = blend(
        0.75 * ends * (0.8 + 0.3 * compute_noise(points, rng, frequency=0.3)), (238, 202, 58), (176, 182, 66)
    )
    ridge = np.clip(np.cos(5 * angle) - 0.93, 0, 1) / 0.07
    colours = blend(ridge * (0.28 + 0.2 * compute_noise(points, rng, frequency=0.6)), colours, (150, 112, 40))
    freckles = compute_noise(points, rng, frequency=1.6, octaves=2, waves=40)
    colours = blend(np.clip(5 * (freckles - 0.70), 0, 0.8), colours, (112, 74, 32))
    stem = np.clip((0.035 - from_stem) / 0.02, 0, 1) * 0.9 + np.clip((0.13 - from_stem) / 0.1, 0, 1) * 0.25
    colours = blend(stem, colours, (104, 84, 40))
    colours = blend(np.clip((from_stem - 0.95) / 0.03, 0, 1), colours, (62, 48, 34))
    colours = colours * (1 + 0.05 * compute_noise(points, rng, frequency=0.5))[..., None]
    painter.put_pixels("skin", np.clip(colours, 0, 255).astype(np.uint8))
    return painter.make_image()
