"""Contact sheet of decisions: one image with the candidates of several decisions, and a legend."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.files import atomic_file
from robocas_ms3.core.text import format_count
from robocas_ms3.viewer.decisions.decision_source import DecisionSource, DecisionView, choose_view
from robocas_ms3.viewer.decisions.outcomes import COLOURS, OUTCOMES

Array = NDArray[np.float64]
Colour = tuple[int, int, int]

COLUMNS = 4
SUFFIXES = (".png", ".jpg", ".jpeg")
"""Suffixes of image files that a contact sheet can be written to."""
_PANEL = (480, 360)  # px, image of a decision
_BAND, _LEGEND, _GAP = 48, 60, 8  # px: text below an image, legend, space between panels
_FINE = 2  # images are drawn this many times larger and then reduced, so that lines are smooth
_PAPER, _INK, _FAINT, _EDGE, _WHITE = (24, 26, 30), (245, 245, 245), (170, 180, 190), (16, 20, 26), (255, 255, 255)
_PLOT, _OBJECT, _TARGET = (238, 240, 243), (203, 209, 217), (170, 200, 250)  # of the plot from above
_WIDTH, _CHOSEN_WIDTH = 2.2, 3.4  # px, of lines
_DASH = 6.0  # px


def write_sheet(source: DecisionSource, path: Path, *, count: int = 20, camera: str | None = None) -> list[int]:
    """Write a contact sheet as PNG or JPEG, and return the rows of the decisions on it.

    Args:
        source: the decisions.
        path: output file; its suffix chooses the format.
        count: largest number of decisions; they are spread evenly over the kinds of decisions and over the file.
        camera: name of a camera, or `TOP_VIEW`. Default: the result of `choose_view` for each decision.

    Raises:
        DatasetError: there are no decisions or no such camera, or the suffix is unknown.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise DatasetError("unknown image format", where=path, expected=" or ".join(SUFFIXES), found=path.suffix)
    rows = select_rows(source, count)
    if not rows:
        raise DatasetError("there are no decisions in this file", where=source.file.path)
    panels = [draw_decision(source, row, camera) for row in rows]
    lines = -(-len(panels) // COLUMNS)
    columns = min(COLUMNS, len(panels))
    width, height = _PANEL[0] + _GAP, _PANEL[1] + _BAND + _GAP
    sheet = Image.new("RGB", (max(columns, 2) * width + _GAP, _LEGEND + lines * height), _PAPER)
    name = "/".join(source.file.path.resolve().parts[-2:])
    _draw_legend(sheet, f"{name}: {len(rows)} of {format_count(len(source), 'decision')}")
    for index, panel in enumerate(panels):
        sheet.paste(panel, (_GAP + index % COLUMNS * width, _LEGEND + index // COLUMNS * height))
    with atomic_file(path) as tmp:
        sheet.save(tmp, quality=92)
    return rows


def select_rows(source: DecisionSource, count: int) -> list[int]:
    """Return up to ``count`` rows of decisions with candidates: kinds in turn, evenly spaced over the file, sorted."""
    decisions = source.file.decisions
    by_kind = [
        np.flatnonzero((decisions["kind"] == kind) & (decisions["candidate_count"] > 0)).tolist()
        for kind in np.unique(decisions["kind"])
    ]
    by_kind.sort(key=len)
    rows: list[int] = []
    for index, found in enumerate(by_kind):
        share = min(len(found), (count - len(rows)) // (len(by_kind) - index))
        if share:
            rows += [found[round(position)] for position in np.linspace(0, len(found) - 1, share)]
    return sorted(rows)


def draw_decision(source: DecisionSource, row: int, camera: str | None = None) -> Image.Image:
    """Draw a panel: the image of a decision with its candidates, cropped to them, and a caption."""
    views = source.views(row)
    shown = choose_view(views) if camera is None else _find_view(views, camera)
    left, top, width, _ = shown.region
    size = _FINE * _PANEL[0], _FINE * _PANEL[1]
    scale = size[0] / width

    def place(pixels: Array) -> list[tuple[float, float]]:
        return [(float(x), float(y)) for x, y in (pixels - (left, top)) * scale]

    background = _crop(source, row, shown, size)
    draw = ImageDraw.Draw(background)
    _draw_objects(draw, shown, place, plot=not (source.images and shown.view.name in source.images.cameras))
    outcomes = source.outcomes[source.file.rows_of(row)].tolist()
    chosen = source.file.candidates["chosen"][source.file.rows_of(row)].tolist()
    for index in sorted(range(len(outcomes)), key=lambda index: (chosen[index], OUTCOMES.index(outcomes[index]))):
        _draw_candidate(
            draw,
            [(place(line.pixels), line.dashed) for line in shown.candidates[index]],
            COLOURS[outcomes[index]],
            chosen[index],
        )
    for thing in shown.objects:
        if thing.target and np.isfinite(thing.pixel).all():
            _draw_name(draw, thing.name, np.array(place(np.vstack([thing.pixel, *thing.outline]))), size)
    panel = Image.new("RGB", (_PANEL[0], _PANEL[1] + _BAND), _PAPER)
    panel.paste(background.resize(_PANEL, Image.Resampling.BOX), (0, 0))
    _draw_caption(panel, source, row, outcomes, shown.view.name)
    return panel


def _find_view(views: Sequence[DecisionView], camera: str) -> DecisionView:
    found = {shown.view.name: shown for shown in views}
    if camera not in found:
        expected = f"one of {', '.join(found)}"
        raise DatasetError("no such camera", where="--camera", expected=expected, found=camera, usage=True)
    return found[camera]


def _crop(source: DecisionSource, row: int, shown: DecisionView, size: tuple[int, int]) -> Image.Image:
    """Return the region of the image of a view in this size; a plain background for the plot from above."""
    if source.images is None or shown.view.name not in source.images.cameras:
        return Image.new("RGB", size, _PLOT)
    image = source.images.rgb(row, shown.view.name)
    left, top, width, height = shown.region
    scale = size[0] / width, size[1] / height
    matrix = np.array([[scale[0], 0, -left * scale[0]], [0, scale[1], -top * scale[1]]])
    return Image.fromarray(cv2.warpAffine(image, matrix, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE))


def _draw_objects(draw: ImageDraw.ImageDraw, shown: DecisionView, place: Any, *, plot: bool) -> None:
    for thing in shown.objects:
        if len(thing.outline) < 3 or not (plot or thing.target):
            continue
        outline = place(np.concatenate([thing.outline, thing.outline[:1]]))
        if plot:
            draw.polygon(outline, _TARGET if thing.target else _OBJECT, (120, 130, 142), _FINE)
        else:
            _draw_dashes(draw, outline, _WHITE, 1.4 * _FINE)


def _draw_name(draw: ImageDraw.ImageDraw, name: str, pixels: Array, size: tuple[int, int]) -> None:
    """Write the name of an object below its pixels (P, 2), the first of which is its position, inside the image."""
    font = _load_font(13 * _FINE)
    half = draw.textlength(name, font) / 2 + 4 * _FINE
    x = float(np.clip(pixels[0, 0], half, max(half, size[0] - half)))
    y = float(np.clip(pixels[:, 1].max() + 10 * _FINE, 8 * _FINE, size[1] - 8 * _FINE))
    draw.text((x, y), name, _WHITE, font, "mm", stroke_width=2 * _FINE, stroke_fill=_EDGE)


def _draw_candidate(draw: ImageDraw.ImageDraw, lines: list[tuple[Any, bool]], colour: Colour, chosen: bool) -> None:
    width = _FINE * (_CHOSEN_WIDTH if chosen else _WIDTH)
    for ink, extra in ((_WHITE if chosen else _EDGE, _FINE * (3.5 if chosen else 1.6)), (colour, 0.0)):
        for points, dashed in lines:
            if dashed:
                _draw_dashes(draw, points, ink, width + extra)
            else:
                draw.line(points, ink, round(width + extra), "curve")


def _draw_dashes(draw: ImageDraw.ImageDraw, points: Any, colour: Colour, width: float) -> None:
    """Draw a dashed line; the dashes follow the corners of the line."""
    path = np.asarray(points, np.float64)
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    for start in np.arange(0, along[-1], 2 * _DASH * _FINE):
        stops = np.unique(np.clip([start, start + _DASH * _FINE, *along], start, min(start + _DASH * _FINE, along[-1])))
        dash = [
            (float(np.interp(stop, along, path[:, 0])), float(np.interp(stop, along, path[:, 1]))) for stop in stops
        ]
        draw.line(dash, colour, round(width))


def _draw_caption(panel: Image.Image, source: DecisionSource, row: int, outcomes: list[str], view: str) -> None:
    values = source.file.decision(row).values
    draw = ImageDraw.Draw(panel)
    title = f"{row}  {values['kind']}: {values['instruction']}"
    _draw_text(draw, (2, _PANEL[1] + 5), title, 15, _INK, _PANEL[0] - 4)
    counts = Counter(outcomes)
    x = 2.0
    for name in reversed(OUTCOMES):
        if counts[name]:
            draw.rectangle((x, _PANEL[1] + 30, x + 9, _PANEL[1] + 39), COLOURS[name])
            text = f"{counts[name]} {name}"
            draw.text((x + 14, _PANEL[1] + 26), text, _FAINT, _load_font(13))
            x += 14 + draw.textlength(text, _load_font(13)) + 12
    right = f"seed {values['seed']}, {view.replace('_camera', '').replace('_', ' ')}"
    draw.text((_PANEL[0] - 2, _PANEL[1] + 26), right, _FAINT, _load_font(13), "ra")


def _draw_legend(sheet: Image.Image, title: str) -> None:
    legend = Image.new("RGB", (_FINE * sheet.width, _FINE * _LEGEND), _PAPER)
    draw = ImageDraw.Draw(legend)
    _draw_text(draw, (_FINE * _GAP, _FINE * 6), title, 18 * _FINE, _INK, legend.width - 2 * _FINE * _GAP)
    x, y = float(_FINE * _GAP), float(_FINE * 44)
    for name in reversed(OUTCOMES):
        half = 6 * _FINE
        draw.rectangle((x, y - half, x + 2 * half, y + half), COLOURS[name])
        x = _label(draw, x + 3 * half, y, name)
    x += 10 * _FINE
    for text, lines, chosen in _LEGEND_SHAPES:
        moved = [([(x + _FINE * px, y + _FINE * py) for px, py in points], dashed) for points, dashed in lines]
        _draw_candidate(draw, moved, _FAINT, chosen)
        x = _label(draw, max(px for points, _ in moved for px, _ in points) + 8 * _FINE, y, text)
    sheet.paste(legend.resize((sheet.width, _LEGEND), Image.Resampling.BOX), (0, 0))


def _label(draw: ImageDraw.ImageDraw, x: float, y: float, text: str) -> float:
    """Draw a text of the legend, vertically centred; return the x of the next entry."""
    draw.text((x, y), text, _INK, _load_font(14 * _FINE), "lm")
    return x + draw.textlength(text, _load_font(14 * _FINE)) + 22 * _FINE


_ARROW: list[tuple[list[tuple[float, float]], bool]] = [
    ([(0, 0), (32, 0)], False),
    ([(23, -7), (32, 0), (23, 7)], False),
]
_LEGEND_SHAPES: list[tuple[str, list[tuple[list[tuple[float, float]], bool]], bool]] = [
    ("grasp", [([(2, 8), (2, -2), (26, -2), (26, 8)], False), ([(14, -2), (14, -10)], False)], False),
    ("push or pull", _ARROW, False),
    (
        "lift",
        [
            ([(2, 8), (2, 0), (14, 0), (14, 8)], False),
            ([(8, 0), (8, -8)], False),
            ([(12, 0), (44, 0)], True),
            ([(37, -6), (44, 0), (37, 6)], False),
        ],
        False,
    ),
    ("release", [([(16 + 8 * np.cos(a), 8 * np.sin(a)) for a in np.linspace(0, 2 * np.pi, 17)], False)], False),
    ("chosen", _ARROW, True),
]


@lru_cache
def _load_font(size: int) -> Any:
    return ImageFont.load_default(size)  # built into Pillow


def _draw_text(
    draw: ImageDraw.ImageDraw, position: tuple[int, int], text: str, size: int, ink: Colour, width: int
) -> None:
    while size > 10 and draw.textlength(text, _load_font(size)) > width:
        size -= 1
    draw.text(position, text, ink, _load_font(size))
