"""Parametric bottles and tubes, see ``shapes``. Those with a lid have the regions side, shoulder, cap, lid, bottom.

Rings are (half_x, half_y, z, exponent, corner cut) in metres, see ``surfaces``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import numpy as np
from pydantic import Field
from scipy.optimize import root_scalar

from asset_tools.builtin.mesh import Patch, Shape, Size, fitted
from asset_tools.builtin.surfaces import (
    Section,
    chained_pieces,
    loft,
    oval_rings,
    prism_piece,
    round_rings,
    stacked_pieces,
    sweep,
)

Ring = tuple[float, float, float, float, float]
Row = Annotated[Sequence[float], Field(min_length=2, max_length=5)]  # of a product's file, see ``bottle``


def bottle(
    size: Size,
    *,
    foot: tuple[float, float, float],
    side: Sequence[Row],
    shoulder: Sequence[Row],
    cap: Sequence[Row],
    cuts: Sequence[float],
) -> Shape:
    """A bottle that is a stack of rings.

    Args:
        size: see ``shapes``.
        foot: half width and half depth of the rounded lower edge, as fractions of the size's; exponent.
        side, shoulder, cap: rings upwards: half width, half depth, height as fractions of the size's, exponent, corner
            cut in m; or, of round ones, radius in m, height as a fraction, corner cut in m (0), exponent (2).
        cuts: see ``stacked_pieces``, as fractions of the height.
    """
    a, b, h = _halves(size)

    def rings(rows: Sequence[Row]) -> list[Ring]:
        found = []
        for row in rows:
            if len(row) == 5:
                x, y, z, exponent, cut = row
                found.append((a * x, b * y, h * z, exponent, cut))
            else:
                radius, z, cut, exponent = (*row, *(0.0, 2.0)[len(row) - 2 :])
                found.append((radius, radius, h * z, exponent, cut))
        return found

    lower = _foot(a * foot[0], b * foot[1], foot[2])
    return _bottle(size, [*lower, *rings(side)], rings(shoulder), rings(cap), cuts=[h * cut for cut in cuts])


def flip_top_bottle(size: Size, *, exponent: float, cap_height: float, taper: float, waist: float) -> Shape:
    """An oval bottle with a waist, whose shoulders continue in a wide oval cap.

    Args:
        size: see ``shapes``. exponent: of its section.
        cap_height: as a fraction of the height. taper: width of the cap as a fraction of the body's.
        waist: how much narrower the middle of the body is, as a fraction of the width.
    """
    a, b, h = _halves(size)
    cap_z, top = h * (1 - cap_height), h * (0.88 - cap_height)
    ca, cb = a * taper, min(b * 0.84, a * taper)
    middle = top * 0.52
    side = [*_foot(a, b, exponent), (a, b, top * 0.14, exponent, 0.03)]
    side += [(a * (1 - waist), b * (1 - waist / 2), middle, exponent, 0.05)]
    side += [(a, b, top * 0.94, exponent, 0.03), (a, b, top, exponent, 0)]
    shoulder = [(a, b, top + 0.35 * (cap_z - top), exponent, 0.02), (ca * 0.97, cb * 0.97, cap_z, 2.2, 0)]
    cap = [(ca, cb, cap_z, 2.2, 0), (ca * 0.97, cb * 0.97, h, 2.2, 0.004), (ca * 0.8, cb * 0.8, h, 2.2, 0)]
    return _bottle(size, side, shoulder, cap, cuts=[middle, cap_z])


def drink_bottle(size: Size) -> Shape:
    """A round bottle with waist, long shoulders and a screw cap."""
    r, _, h = _halves(size)
    side = [_neck(r * 0.8, 0), _neck(r, 0, 0.008), _neck(r, h * 0.16, 0.004)]
    side += [_neck(r * 0.93, h * 0.2, 0.006), _neck(r * 0.93, h * 0.24, 0.006), _neck(r, h * 0.28, 0.004)]
    side += [_neck(r, h * 0.62)]
    shoulder = [_neck(r, h * 0.72, 0.04), _neck(0.0135, h * 0.88, 0.01), _neck(0.0135, h * 0.905)]
    cap = [_neck(0.0155, h * 0.905), _neck(0.0155, h, 0.0015), _neck(0.012, h)]
    # straight through the waist, which is 2 mm deep; lying, it rests on one facet
    pieces = [
        prism_piece([(r * 0.86, 0), (r, 0.005), (r, h * 0.65)]),
        prism_piece([(r, h * 0.65), (r * 0.9, h * 0.73), (0.0135, h * 0.87)]),
        prism_piece([(0.0135, h * 0.87), (0.0135, h * 0.905)]),
        prism_piece([(0.0155, h * 0.905), (0.0155, h)]),
    ]
    return _bottle(size, side, shoulder, cap, pieces=pieces)


def pump_bottle(size: Size, *, exponent: float, body: float) -> Shape:
    """A bottle with a pump, its spout towards +x. Regions: side, shoulder, cap, spout, bottom.

    Args:
        size: see ``shapes``. exponent: of its section.
        body: height of its straight part, as a fraction of the height.
    """
    a, b, h = _halves(size)
    side = [*_foot(a, b, exponent), (a, b, h * body, exponent, 0)]
    neck = body + 0.105
    shoulder = [(a, b, h * (body + 0.07), exponent, 0.02), _neck(0.0145, h * neck, 0.002), _neck(0.0135, h * neck)]
    cap = [_neck(0.016, h * neck), _neck(0.0155, h * (neck + 0.08), 0.002), _neck(0.006, h * (neck + 0.085), 0.001)]
    cap += [_neck(0.005, h * 0.93, 0.001), (0.0135, 0.0115, h * 0.935, 2.4, 0.002)]
    cap += [(0.0145, 0.0125, h, 2.4, 0.004), _neck(0, h)]
    t = np.linspace(0, 1, 7)
    path = np.stack([0.004 + (a - 0.006) * t, 0 * t, h * 0.972 - 0.009 * t**3], axis=-1)
    radii = np.stack([0.0048 - 0.0014 * t, 0.0062 - 0.0024 * t], axis=-1)
    path, radii = np.concatenate([path[:1], path, path[-1:]]), np.concatenate([[[0, 0]], radii, [[0, 0]]])
    path[0, 0] -= 1e-4
    path[-1, 0] += 1e-4
    spout = sweep("spout", path, radii, normal=(0, 1, 0), segments=10, detail=0.5)
    return _bottle(size, side, shoulder, cap, cuts=[h * body, h * neck, h * (neck + 0.085), h * 0.93], spout=spout)


def upended_bottle(size: Size) -> Shape:
    """A bottle standing on its wide flat cap, broadest near its domed top. Regions: side, shoulder, cap, lid."""
    a, b, h = _halves(size)
    ca, cb, z = a * 0.74, b * 0.86, h * 0.15
    cap = [(ca * 0.94, cb * 0.94, 0, 2.6, 0), (ca, cb, 0, 2.6, 0.002), (ca, cb, z, 2.6, 0.001)]
    cap += [(ca * 0.96, cb * 0.95, z, 2.6, 0)]
    side = [cap[-1], (a * 0.80, b * 0.94, h * 0.3, 2.6, 0.05), (a, b, h * 0.74, 2.6, 0.04), (a, b, h * 0.88, 2.6, 0)]
    dome = [side[-1], (a * 0.97, b * 0.96, h * 0.985, 2.6, 0.018), (a * 0.55, b * 0.5, h, 2.4, 0.015), _neck(0, h)]
    part = loft(
        [
            Section("lid", oval_rings([_neck(0, 0), cap[0]]), flat=True, detail=0.5),
            Section("cap", oval_rings(cap), detail=0.5),
            Section("side", oval_rings(side, steps=3)),
            Section("shoulder", oval_rings(dome, steps=4), flat=False, detail=0.4),
        ]
    )
    return fitted([part], size, pieces=stacked_pieces(part, [z, h * 0.34]))


def tube(size: Size, *, cap_radius: float, cap_height: float, flare: float = 1.0) -> Shape:
    """A squeeze tube standing on its cap: round there, blending into a flat crimp on top. Regions: side, cap, lid.

    Its circumference is the same all along, as of a real tube: the crimp is pi / 2 times as wide as the round end.

    Args:
        size: see ``shapes``; the depth is the diameter of the round end.
        cap_radius: of the cap where it meets the tube, m. cap_height: m.
        flare: additional width of the cap at its base.
    """
    r, h, thick = size[1] / 2, size[2], 0.0008
    perimeter = 2 * np.pi * r

    def half_x(half_y: float) -> float:
        return root_scalar(lambda x: _ellipse_perimeter(x, half_y) - perimeter, bracket=(half_y * 0.99, np.pi * r)).root

    start, crimp = cap_height + 0.007, h - 0.008
    body = [(cap_radius * 0.97, cap_radius * 0.97, cap_height, 2.0), (cap_radius, cap_radius, cap_height, 2.0)]
    body.append((r * 0.96, r * 0.96, start - 0.001, 2.0))
    for fraction in np.linspace(0, 1, 11):
        half_y = r + (thick - r) * fraction**1.25
        body.append((half_x(half_y), half_y, start + (crimp - start) * fraction, 2.0))
    flat = body[-1][0]
    body += [(flat, thick, h - 0.0005, 2.0), (flat, 0.0, h, 2.0)]
    foot = cap_radius * flare
    cap = [(foot * 0.9, 0, 0), (foot, 0, 0.002), (cap_radius, cap_height, 0.001), (cap_radius * 0.97, cap_height, 0)]
    sections = [
        Section("lid", round_rings([(0, 0, 0), (foot * 0.9, 0, 0)]), flat=True, detail=0.5),
        Section("cap", round_rings(cap), detail=0.6),
        Section("side", np.array(body)),
    ]
    part = loft(sections)
    return fitted([part], size, pieces=stacked_pieces(part, [cap_height, start]))


def _bottle(
    size: Size,
    side: Sequence[Ring],
    shoulder: Sequence[Ring],
    cap: Sequence[Ring],
    *,
    cuts: Sequence[float] = (),
    pieces: list[np.ndarray] | None = None,
    spout: list[Patch] | None = None,
) -> Shape:
    """Body, shoulder and cap, each beginning where the one before ends; a flat lid, unless the cap closes itself.

    Args:
        size: see ``shapes``. side, shoulder, cap: rings, upwards.
        cuts: see ``stacked_pieces``. pieces: convex ones, instead of those cut there.
        spout: a separate part.
    """
    a, b, _, n, _ = side[0]
    shoulder, cap = [(*side[-1][:4], 0), *shoulder], [(*shoulder[-1][:4], 0), *cap]
    bottom = [(0, 0, 0.003, n, 0), (a * 0.78, b * 0.74, 0.003, n, 0.004), side[0]]
    sections = [
        Section("bottom", oval_rings(bottom), flat=True, detail=0.4),
        Section("side", oval_rings(list(side), steps=3)),
        Section("shoulder", oval_rings(shoulder, steps=4), detail=0.4),
        Section("cap", oval_rings(cap, steps=3), detail=0.5),
    ]
    if cap[-1][0] > 0:
        lid = [cap[-1], (0, 0, *cap[-1][2:])]
        sections.append(Section("lid", oval_rings(lid), flat=True, detail=0.6))
    part = loft(sections)
    pieces = stacked_pieces(part, cuts) if pieces is None else pieces
    if spout is None:
        return fitted([part], size, pieces=pieces)
    return fitted([part, spout], size, pieces=pieces + chained_pieces(spout[0], 2))


def _halves(size: Size) -> tuple[float, float, float]:
    return size[0] / 2, size[1] / 2, size[2]


def _foot(a: float, b: float, exponent: float) -> list[Ring]:
    """The rounded lower edge of a body of half sizes a and b."""
    return [(a * 0.88, b * 0.86, 0, exponent, 0), (a, b, 0, exponent, 0.007)]


def _neck(radius: float, z: float, cut: float = 0.0) -> Ring:
    """A round ring."""
    return radius, radius, z, 2.0, cut


def _ellipse_perimeter(a: float, b: float) -> float:
    """Approximate the perimeter as Ramanujan did."""
    return np.pi * (3 * (a + b) - np.sqrt((3 * a + b) * (a + 3 * b)))
