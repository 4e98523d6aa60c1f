"""Paint the label of a product on cartons, round packages, tubes, soap and mugs."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from PIL import Image
from pydantic import AfterValidator

from asset_tools.builtin.mesh import Shape
from asset_tools.builtin.motifs import MOTIFS
from asset_tools.builtin.textures import Box, Canvas, Colour, Painter
from robocas_ms3.core.strict_model import StrictModel

METAL = (186, 190, 194)
PLATED = ("stripes", "diagonal", "dots")  # styles with a pattern; the text is on a plate of the base colour


FACTS = {  # heading and rows of the table on the back
    "food": (
        "Contents",
        [("Energy", "420 kJ"), ("Fat", "0.8 g"), ("Sugars", "9.5 g"), ("Protein", "2.1 g"), ("Salt", "0.6 g")],
    ),
    "care": (
        "Directions",
        [("Use", "daily"), ("Skin", "all"), ("Water", "70 %"), ("Keep", "cool"), ("Open", "1 year")],
    ),
}


def _known(motif: str) -> str:
    if motif not in MOTIFS:
        raise ValueError(f"unknown motif {motif!r}: expected one of {', '.join(MOTIFS)}")
    return motif


class Label(StrictModel):
    """Text, colours and pattern of a package.

    Attributes:
        title: name of the product, with or without line breaks.
        subtitle: text below the title.
        amount: text at the bottom, such as "500 ml".
        base: first colour of the package.
        accent: second colour of the package.
        ink: colour of the letters.
        outline: colour of an outline around the title; None: no outline.
        amount_ink: colour of the amount; None: ``ink``.
        style: pattern of the second colour.
        motif: name of a picture in ``MOTIFS``.
        cap: colour of lids, caps and nozzles.
        ridged: whether the cap has vertical grooves, as screw caps have; otherwise it has the seam of a flip-top lid.
        turn: rotation of the front in degrees; 90 for tubes.
        facts: name of the table on the back in ``FACTS``.
    """

    title: str
    subtitle: str = ""
    amount: str = ""
    base: Colour
    accent: Colour
    ink: Colour
    motif: Annotated[str, AfterValidator(_known)]
    style: Literal["bands", "half", "wave", "stripes", "diagonal", "panel", "dots", "plain"] = "bands"
    outline: Colour | None = None
    amount_ink: Colour | None = None
    cap: Colour = (240, 240, 238)
    ridged: bool = True
    turn: Literal[0, 90] = 0
    facts: Literal["food", "care"] = "food"


def paint_carton(shape: Shape, rng: np.random.Generator, *, label: Label) -> Image.Image:
    """Paint the six faces of a box; the largest faces show the front of the label."""
    painter = Painter(shape, rng, label.base)
    largest = max(region.size[0] * region.size[1] for region in shape.regions.values())
    for name, region in shape.regions.items():
        wide, high = region.size
        with painter.open_region(name) as canvas:
            _background(canvas, label)
            if wide * high > 0.6 * largest:
                _front(canvas, (0.06, 0.15, 0.94, 0.85) if label.style == "bands" else (0.05, 0.04, 0.95, 0.96), label)
            elif name == "right" and high > wide:
                canvas.draw_table((0.1, 0.3, 0.9, 0.75), *FACTS[label.facts])
                canvas.draw_text(label.amount, (0.1, 0.8, 0.9, 0.9), label.ink, bold=0.03)
            elif name == "left" and high > wide:
                canvas.draw_text(
                    label.title.replace("\n", " "),
                    (0.2, 0.22, 0.8, 0.72),
                    label.ink,
                    bold=0.04,
                    turn=90,
                    outline=label.outline,
                )
                canvas.draw_barcode((0.15, 0.8, 0.85, 0.93))
            elif name == "left":
                canvas.draw_barcode((0.15, 0.2, 0.85, 0.8))
            else:
                canvas.draw_text(
                    label.title.replace("\n", " "), (0.1, 0.2, 0.9, 0.8), label.ink, bold=0.04, outline=label.outline
                )
    return painter.make_image()


def paint_wrapped(shape: Shape, rng: np.random.Generator, *, label: Label, metal: bool = False) -> Image.Image:
    """Paint a can, jar or bottle: the label around the ``side``, and caps and lids of one colour.

    Args:
        shape: shape with the region ``side``; it may have shoulder, rim, cap, spout, lid and bottom.
        rng: random generator for bar codes.
        label: the label.
        metal: whether rims, lids and bottoms are of metal.
    """
    painter = Painter(shape, rng, label.base)
    with painter.open_region("side") as canvas:
        _background(canvas, label)
        wide, high = shape.regions["side"].size
        half = min(0.2, 0.9 * high / wide / 2 + 0.06)
        if label.style == "panel":
            canvas.draw_rectangle((0.5 - half - 0.035, 0.1, 0.5 + half + 0.035, 0.93), label.accent, corner=0.12)
        top, bottom = (0.14, 0.86) if label.style == "bands" else (0.12, 0.91)
        _front(canvas, (0.5 - half, top, 0.5 + half, bottom), label)
        canvas.draw_table((0.825, 0.22, 0.99, 0.8), *FACTS[label.facts])
        if label.style in ("panel", *PLATED):
            ground = label.accent if label.style == "panel" else label.base
            canvas.draw_rectangle((0.01, 0.22, 0.175, 0.84), ground, corner=0.12)
        canvas.draw_barcode((0.025, 0.62, 0.155, 0.8))
        canvas.draw_text(label.title, (0.015, 0.26, 0.17, 0.54), label.ink, bold=0.04, outline=label.outline)
    for name in ("rim", "bottom", "lid", "cap", "spout"):
        painter.fill_region(name, METAL if metal else label.cap)
    painter.fill_region(
        "bottom", METAL if metal else label.accent if label.style in ("bands", "half", "wave") else label.base
    )
    _cap(painter, label)
    if metal:
        for name in ("lid", "bottom"):
            _rings(painter, name, METAL)
    elif "lid" in shape.regions:
        with painter.open_region("lid", label.cap) as canvas:
            ink = (70, 70, 74) if sum(label.cap) > 380 else (244, 244, 240)
            canvas.draw_text(label.title, (0.2, 0.28, 0.8, 0.72), ink, bold=0.03)
    return painter.make_image()


def paint_tube(shape: Shape, rng: np.random.Generator, *, label: Label) -> Image.Image:
    """Paint a tube, with the label along the body, on the front and the back."""
    painter = Painter(shape, rng, label.base)
    with painter.open_region("side") as canvas:
        _background(canvas, label)
        canvas.draw_rectangle((0, 0, 1, 0.055), label.accent)
        _front(canvas, (0.30, 0.14, 0.70, 0.86), label)
        canvas.draw_table((0.8, 0.28, 0.97, 0.66), *FACTS[label.facts])
        if label.style in PLATED:
            canvas.draw_rectangle((0.04, 0.12, 0.21, 0.68), label.base, corner=0.12)
        canvas.draw_barcode((0.05, 0.5, 0.2, 0.66))
        canvas.draw_text(label.title, (0.05, 0.15, 0.2, 0.46), label.ink, bold=0.04, turn=90, outline=label.outline)
    _cap(painter, label)
    painter.fill_region("lid", label.cap)
    return painter.make_image()


def paint_soap(shape: Shape, rng: np.random.Generator, *, label: Label) -> Image.Image:
    """Paint a bar of soap with its name on the top and the bottom."""
    painter = Painter(shape, rng, label.base)
    for name in ("top", "bottom"):
        with painter.open_region(name) as canvas:
            canvas.draw_rectangle((0.17, 0.24, 0.83, 0.76), label.accent, corner=0.45)
            canvas.draw_rectangle((0.18, 0.255, 0.82, 0.745), label.base, corner=0.45)
            canvas.draw_text(label.title, (0.24, 0.34, 0.76, 0.66), label.ink, bold=0.03, outline=label.accent)
    return painter.make_image()


def paint_mug(shape: Shape, rng: np.random.Generator, *, label: Label) -> Image.Image:
    """Paint a glazed mug with a coloured band and a text around it."""
    painter = Painter(shape, rng, label.base)
    with painter.open_region("side") as canvas:
        canvas.draw_rectangle((0, 0.3, 1, 0.78), label.accent)
        for x in np.arange(24) / 24:
            canvas.draw_polygon([(x, 0.3), (x + 1 / 24, 0.3), (x + 0.5 / 24, 0.36)], label.base)
            canvas.draw_polygon([(x, 0.78), (x + 1 / 24, 0.78), (x + 0.5 / 24, 0.72)], label.base)
        for left in (0.36, 0.86 - 1.0, 0.86):  # in front, and across the seam at the back
            canvas.draw_text(label.title, (left, 0.41, left + 0.28, 0.67), label.ink, bold=0.04)
    for name in ("inside", "floor"):
        painter.fill_region(name, label.cap)
    return painter.make_image()


def _background(canvas: Canvas, label: Label) -> None:
    """Draw the pattern of the second colour on the whole canvas; it continues at the seam of a cylinder."""
    if label.style == "bands":
        for top, bottom in ((0, 0.1), (0.12, 0.135), (0.865, 0.88), (0.9, 1)):
            canvas.draw_rectangle((0, top, 1, bottom), label.accent)
    elif label.style == "half":
        canvas.draw_rectangle((0, 0.54, 1, 1), label.accent)
        canvas.draw_rectangle((0, 0.53, 1, 0.55), (222, 184, 92))
    elif label.style == "wave":
        lighter = tuple(round(0.5 * (a + b)) for a, b in zip(label.base, label.accent, strict=True))
        canvas.fill_wave(0.62, 0.06, 2, (lighter[0], lighter[1], lighter[2]))
        canvas.fill_wave(0.7, 0.06, 2, label.accent)
    elif label.style == "stripes":
        for x in np.arange(12) / 12:
            canvas.draw_rectangle((x, 0, x + 1 / 24, 1), label.accent)
    elif label.style == "diagonal":
        for x in np.arange(-2, 4) / 2:
            canvas.draw_polygon([(x, 0), (x + 0.22, 0), (x - 0.28, 1), (x - 0.5, 1)], label.accent)
    elif label.style == "dots":
        for i, j in np.ndindex(9, 12):
            canvas.draw_disc((j + 0.5 * (i % 2)) / 12, (i + 0.5) / 9, 0.018, label.accent)


def _front(canvas: Canvas, box: Box, label: Label) -> None:
    """Draw motif, title, subtitle and amount in a box, in a column or, if the box is wide, in a row.

    The whole drawing is rotated by ``label.turn``.
    """
    left, top, right, bottom = canvas.to_pixels(box)
    wide, high = right - left, bottom - top
    area = canvas.image.crop((left, top, right, bottom)).rotate(-label.turn, expand=True)
    inner = Canvas((area.width, area.height), 1, label.base, canvas.rng)
    inner.image.paste(area)
    wide, high = area.width, area.height
    plate = label.style in PLATED
    if wide > 1.6 * high:
        if plate:
            inner.draw_rectangle((0.0, 0.12, 1, 0.88), label.base, corner=0.3)
        radius = 0.3 * high
        MOTIFS[label.motif](inner.draw, 0.04 * wide + radius, 0.5 * high, radius)
        start = 0.07 + 2 * radius / wide
        inner.draw_text(
            label.title.replace("\n", " "), (start, 0.2, 0.96, 0.6), label.ink, bold=0.05, outline=label.outline
        )
        inner.draw_text(label.subtitle, (start, 0.65, 0.78, 0.82), label.ink)
        inner.draw_text(label.amount, (0.82, 0.65, 0.96, 0.82), label.ink, bold=0.03)
    else:
        if plate:
            inner.draw_rectangle((0.0, 0.0, 1, 1), label.base, corner=0.12)
        radius = min(0.17 * high, 0.42 * wide)
        inner.draw_text(label.title, (0.04, 0.06, 0.96, 0.38), label.ink, bold=0.05, outline=label.outline)
        inner.draw_text(label.subtitle, (0.08, 0.4, 0.92, 0.48), label.ink, bold=0.02)
        MOTIFS[label.motif](inner.draw, 0.5 * wide, 0.68 * high, radius)
        inner.draw_text(label.amount, (0.3, 0.89, 0.7, 0.97), label.amount_ink or label.ink, bold=0.03)
    canvas.image.paste(inner.image.rotate(label.turn, expand=True), (left, top))


def _cap(painter: Painter, label: Label) -> None:
    """Paint the cap, if the shape has one: vertical grooves of a screw cap, or the seam of a flip-top lid."""
    if "cap" in painter.shape.regions:
        angle, level = painter.compute_grid("cap")
        groove = np.cos(angle * 40)[None, :] > 0.3 if label.ridged else np.abs(level - 0.42)[:, None] < 0.025
        shade = 1 - (0.13 if label.ridged else 0.3) * np.broadcast_to(groove, (len(level), len(angle)))
        painter.put_pixels("cap", (shade[..., None] * np.asarray(label.cap)).astype(np.uint8))


def _rings(painter: Painter, name: str, colour: Colour) -> None:
    """Paint the concentric grooves on the lid of a can."""
    with painter.open_region(name, colour) as canvas:
        for radius, shade in ((0.44, 1.1), (0.41, 0.86), (0.395, 1.0), (0.33, 1.1), (0.305, 0.88), (0.29, 1.02)):
            tone = tuple(min(255, round(c * shade)) for c in colour)
            canvas.draw_disc(0.5, 0.5, radius, (tone[0], tone[1], tone[2]), stretch=canvas.width / canvas.height)
