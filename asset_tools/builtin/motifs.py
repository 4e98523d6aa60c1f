"""Draw small images on labels, centred at (x, y), with radius r, in pixels."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from PIL import ImageDraw

Pen = ImageDraw.ImageDraw
GREEN, DARK_GREEN, WHITE = (74, 140, 58), (44, 98, 44), (252, 252, 248)


def _disc(pen: Pen, x: float, y: float, r: float, fill: tuple[int, int, int], stretch: float = 1.0) -> None:
    pen.ellipse((x - r * stretch, y - r, x + r * stretch, y + r), fill=fill)


def _ray_points(
    x: float, y: float, inner: float, outer: float, count: int, turn: float = 0.0
) -> list[tuple[float, float]]:
    """Return the corners (x, y) of a star with ``count`` rays, in pixels."""
    angle = np.arange(2 * count) * np.pi / count + turn
    radius = np.where(np.arange(2 * count) % 2 == 0, outer, inner)
    return list(zip((x + radius * np.sin(angle)).tolist(), (y - radius * np.cos(angle)).tolist(), strict=True))


def _leaf(pen: Pen, x: float, y: float, length: float, angle: float, fill: tuple[int, int, int] = GREEN) -> None:
    t = np.linspace(0, 1, 15)
    half = 0.24 * np.sin(np.pi * t) * (1.15 - 0.5 * t)
    along, across = np.concatenate([t, t[::-1]]), np.concatenate([half, -half[::-1]])
    px = x + length * (along * np.cos(angle) - across * np.sin(angle))
    py = y - length * (along * np.sin(angle) + across * np.cos(angle))
    pen.polygon(list(zip(px.tolist(), py.tolist(), strict=True)), fill=fill)
    tip = (x + 0.9 * length * np.cos(angle), y - 0.9 * length * np.sin(angle))
    pen.line([(x, y), tip], fill=DARK_GREEN, width=max(1, round(length * 0.04)))


def draw_tomato(pen: Pen, x: float, y: float, r: float) -> None:
    """Draw a tomato, centred at (x, y), with radius r, in pixels."""
    _disc(pen, x, y + 0.08 * r, 0.9 * r, (205, 38, 30), 1.08)
    _disc(pen, x - 0.35 * r, y - 0.2 * r, 0.2 * r, (232, 104, 84))
    pen.polygon(_ray_points(x, y - 0.62 * r, 0.13 * r, 0.5 * r, 6), fill=DARK_GREEN)


def draw_sun(pen: Pen, x: float, y: float, r: float) -> None:
    """Draw a sun, centred at (x, y), with radius r, in pixels."""
    pen.polygon(_ray_points(x, y, 0.62 * r, r, 14), fill=(250, 190, 40))
    _disc(pen, x, y, 0.56 * r, (255, 226, 96))


def draw_leaf(pen: Pen, x: float, y: float, r: float) -> None:
    """Draw three leaves, centred at (x, y), with radius r, in pixels."""
    for angle in (0.5, 1.57, 2.64):
        _leaf(pen, x, y + 0.7 * r, 1.6 * r if angle == 1.57 else 1.25 * r, angle, GREEN)


def draw_drop(pen: Pen, x: float, y: float, r: float) -> None:
    """Draw a drop of water, centred at (x, y), with radius r, in pixels."""
    pen.polygon([(x, y - r), (x - 0.56 * r, y + 0.15 * r), (x + 0.56 * r, y + 0.15 * r)], fill=(64, 150, 218))
    _disc(pen, x, y + 0.33 * r, 0.62 * r, (64, 150, 218))
    _disc(pen, x - 0.22 * r, y + 0.42 * r, 0.17 * r, (190, 226, 248))


def draw_strawberry(pen: Pen, x: float, y: float, r: float) -> None:
    """Draw a strawberry, centred at (x, y), with radius r, in pixels."""
    red = (208, 28, 48)
    _disc(pen, x - 0.36 * r, y - 0.22 * r, 0.46 * r, red)
    _disc(pen, x + 0.36 * r, y - 0.22 * r, 0.46 * r, red)
    pen.polygon([(x - 0.8 * r, y - 0.12 * r), (x + 0.8 * r, y - 0.12 * r), (x, y + r)], fill=red)
    for dx, dy in ((-0.4, -0.1), (0, -0.15), (0.4, -0.1), (-0.22, 0.2), (0.22, 0.2), (0, 0.5)):
        _disc(pen, x + dx * r, y + dy * r, 0.06 * r, (250, 214, 110))
    pen.polygon(_ray_points(x, y - 0.6 * r, 0.14 * r, 0.48 * r, 7), fill=GREEN)


def draw_chips(pen: Pen, x: float, y: float, r: float) -> None:
    """Draw three potato chips, centred at (x, y), with radius r, in pixels."""
    for dx, dy, shade in ((-0.5, 0.3, 0), (0.5, 0.3, 8), (0, -0.2, 16)):
        _disc(pen, x + dx * r, y + dy * r, 0.5 * r, (214 + shade, 150 + shade, 40), 1.15)
        _disc(pen, x + dx * r, y + dy * r, 0.42 * r, (244, 200 + shade, 92), 1.15)
        _disc(pen, x + (dx - 0.15) * r, y + (dy - 0.1) * r, 0.08 * r, (222, 164, 60), 1.4)


def draw_flower(pen: Pen, x: float, y: float, r: float, petal: tuple[int, int, int] = (252, 222, 70)) -> None:
    """Draw a flower with petals of a colour, centred at (x, y), with radius r, in pixels."""
    for angle in np.arange(8) * np.pi / 4:
        _disc(pen, x + 0.58 * r * np.cos(angle), y + 0.58 * r * np.sin(angle), 0.36 * r, petal)
    _disc(pen, x, y, 0.36 * r, (150, 90, 30))


def draw_blossom(pen: Pen, x: float, y: float, r: float) -> None:
    """Draw a pink flower, centred at (x, y), with radius r, in pixels."""
    draw_flower(pen, x, y, r, (246, 170, 196))


def draw_citrus(pen: Pen, x: float, y: float, r: float) -> None:
    """Draw a slice of an orange, centred at (x, y), with radius r, in pixels."""
    _disc(pen, x, y, r, (240, 130, 20))
    _disc(pen, x, y, 0.86 * r, (255, 236, 196))
    for angle in range(0, 360, 45):
        pen.pieslice((x - 0.8 * r, y - 0.8 * r, x + 0.8 * r, y + 0.8 * r), angle + 4, angle + 41, fill=(250, 160, 40))


def draw_cubes(pen: Pen, x: float, y: float, r: float) -> None:
    """Draw three sugar cubes, centred at (x, y), with radius r, in pixels."""
    for dx, dy in ((-0.48, 0.42), (0.48, 0.42), (0, -0.4)):
        cx, cy, s = x + dx * r, y + dy * r, 0.46 * r
        top = [(cx, cy - s), (cx + s, cy - 0.5 * s), (cx, cy), (cx - s, cy - 0.5 * s)]
        left = [(cx - s, cy - 0.5 * s), (cx, cy), (cx, cy + s), (cx - s, cy + 0.5 * s)]
        right = [(cx + s, cy - 0.5 * s), (cx, cy), (cx, cy + s), (cx + s, cy + 0.5 * s)]
        for side, shade in ((top, 255), (left, 226), (right, 200)):
            pen.polygon(side, fill=(shade, shade, shade), outline=(150, 160, 175))


def draw_meat(pen: Pen, x: float, y: float, r: float) -> None:
    """Draw three slices of ham, centred at (x, y), with radius r, in pixels."""
    for dx in (-0.42, 0.0, 0.42):
        _disc(pen, x + dx * r, y, 0.66 * r, (160, 60, 52), 0.82)
        _disc(pen, x + dx * r, y, 0.6 * r, (232, 138, 128), 0.82)
        _disc(pen, x + dx * r, y - 0.12 * r, 0.1 * r, (250, 200, 190), 1.6)


def draw_star(pen: Pen, x: float, y: float, r: float) -> None:
    """Draw a star with five points, centred at (x, y), with radius r, in pixels."""
    pen.polygon(_ray_points(x, y, 0.42 * r, r, 5), fill=WHITE)


def draw_sparkle(pen: Pen, x: float, y: float, r: float) -> None:
    """Draw two thin stars, centred at (x, y), with radius r, in pixels."""
    pen.polygon(_ray_points(x - 0.15 * r, y + 0.1 * r, 0.2 * r, 0.95 * r, 4), fill=WHITE)
    pen.polygon(_ray_points(x + 0.62 * r, y - 0.6 * r, 0.1 * r, 0.42 * r, 4), fill=WHITE)


def draw_bubbles(pen: Pen, x: float, y: float, r: float) -> None:
    """Draw four bubbles, centred at (x, y), with radius r, in pixels."""
    for dx, dy, size in ((-0.35, 0.45, 0.46), (0.42, 0.2, 0.34), (-0.1, -0.35, 0.28), (0.38, -0.7, 0.2)):
        cx, cy, s = x + dx * r, y + dy * r, size * r
        pen.ellipse(
            (cx - s, cy - s, cx + s, cy + s), fill=(206, 236, 250), outline=WHITE, width=max(1, round(0.08 * r))
        )
        _disc(pen, cx - 0.3 * s, cy - 0.35 * s, 0.22 * s, WHITE)


def draw_olive(pen: Pen, x: float, y: float, r: float) -> None:
    """Draw two olives with leaves, centred at (x, y), with radius r, in pixels."""
    _leaf(pen, x, y - 0.2 * r, 1.0 * r, 0.6)
    _leaf(pen, x, y - 0.2 * r, 1.0 * r, 2.5)
    for dx in (-0.36, 0.36):
        _disc(pen, x + dx * r, y + 0.4 * r, 0.46 * r, (112, 130, 48), 0.76)
        _disc(pen, x + (dx - 0.1) * r, y + 0.22 * r, 0.1 * r, (186, 200, 120))


def draw_lily(pen: Pen, x: float, y: float, r: float) -> None:
    """Draw a water lily, centred at (x, y), with radius r, in pixels."""
    for angle, length in ((0.25, 0.9), (2.89, 0.9), (0.72, 1.05), (2.42, 1.05), (1.17, 1.2), (1.97, 1.2), (1.57, 1.3)):
        _leaf(pen, x, y + 0.55 * r, length * r, angle, (236, 150, 186) if angle != 1.57 else (246, 186, 210))
    pen.pieslice((x - 0.95 * r, y + 0.36 * r, x + 0.95 * r, y + 0.84 * r), 0, 180, fill=GREEN)


def draw_crown(pen: Pen, x: float, y: float, r: float) -> None:
    """Draw a crown, centred at (x, y), with radius r, in pixels."""
    gold, dark = (252, 224, 130), (84, 44, 20)
    spikes = [(-0.9, -0.45), (-0.45, 0.05), (0, -0.7), (0.45, 0.05), (0.9, -0.45), (0.7, 0.6), (-0.7, 0.6)]
    pen.polygon([(x + dx * r, y + dy * r) for dx, dy in spikes], fill=gold, outline=dark)
    for dx, dy in ((-0.88, -0.47), (0, -0.74), (0.88, -0.47)):
        _disc(pen, x + dx * r, y + dy * r, 0.11 * r, gold)
    pen.rectangle((x - 0.68 * r, y + 0.32 * r, x + 0.68 * r, y + 0.44 * r), fill=dark)


def draw_coconut(pen: Pen, x: float, y: float, r: float) -> None:
    """Draw half a coconut and a leaf, centred at (x, y), with radius r, in pixels."""
    _leaf(pen, x + 0.1 * r, y - 0.2 * r, 0.85 * r, 0.8)
    _disc(pen, x, y + 0.1 * r, 0.86 * r, (106, 66, 36), 1.05)
    _disc(pen, x, y + 0.08 * r, 0.74 * r, WHITE, 1.05)
    _disc(pen, x, y + 0.12 * r, 0.46 * r, (222, 226, 220), 1.1)


def draw_bamboo(pen: Pen, x: float, y: float, r: float) -> None:
    """Draw two bamboo canes with leaves, centred at (x, y), with radius r, in pixels."""
    for dx, low in ((-0.3, 0.9), (0.18, 0.6)):
        for i in range(3):
            top = y + (low - 0.55 * (i + 1)) * r
            box = (x + (dx - 0.15) * r, top, x + (dx + 0.15) * r, top + 0.5 * r)
            pen.rounded_rectangle(box, 0.06 * r, fill=(112, 158, 70))
    _leaf(pen, x + 0.2 * r, y - 0.4 * r, 0.72 * r, 0.5)
    _leaf(pen, x - 0.3 * r, y - 0.3 * r, 0.62 * r, 2.7)


def draw_shield(pen: Pen, x: float, y: float, r: float) -> None:
    """Draw a shield with a drop of oil, centred at (x, y), with radius r, in pixels."""
    t = np.linspace(0, 1, 12)
    half, level = 0.78 * np.sqrt(1 - t**2.2), -0.45 + 1.4 * t
    right = list(zip((x + half * r).tolist(), (y + level * r).tolist(), strict=True))
    left = [(2 * x - px, py) for px, py in right[::-1]]
    pen.polygon([(x, y - 0.8 * r), *right, *left], fill=(226, 230, 236))
    pen.polygon([(x, y - 0.5 * r), (x - 0.3 * r, y + 0.1 * r), (x + 0.3 * r, y + 0.1 * r)], fill=(240, 168, 30))
    _disc(pen, x, y + 0.2 * r, 0.33 * r, (240, 168, 30))


def draw_snowflake(pen: Pen, x: float, y: float, r: float) -> None:
    """Draw a snowflake, centred at (x, y), with radius r, in pixels."""
    width = max(1, round(0.11 * r))
    for angle in np.arange(6) * np.pi / 3 + np.pi / 6:
        cos, sin = float(np.cos(angle)), float(np.sin(angle))
        pen.line([(x, y), (x + 0.92 * r * cos, y + 0.92 * r * sin)], fill=WHITE, width=width)
        for turn in (-0.8, 0.8):
            tip = 0.34 * float(np.cos(angle + turn)), 0.34 * float(np.sin(angle + turn))
            start = x + 0.5 * r * cos, y + 0.5 * r * sin
            pen.line([start, (start[0] + tip[0] * r, start[1] + tip[1] * r)], fill=WHITE, width=width)


MOTIFS: dict[str, Callable[[Pen, float, float, float], None]] = {
    function.__name__.removeprefix("draw_"): function
    for function in (
        draw_tomato,
        draw_sun,
        draw_leaf,
        draw_drop,
        draw_strawberry,
        draw_chips,
        draw_flower,
        draw_blossom,
        draw_citrus,
        draw_cubes,
        draw_meat,
        draw_star,
        draw_sparkle,
        draw_bubbles,
        draw_olive,
        draw_lily,
        draw_crown,
        draw_coconut,
        draw_bamboo,
        draw_shield,
        draw_snowflake,
    )
}
