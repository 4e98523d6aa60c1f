"""Make bottles and tubes of a given size, as in ``shapes``.

If a docstring names no regions of the texture, they are side, shoulder, cap, lid, bottom. A ring is
(half_x, half_y, z, exponent, length that is cut off to round the corner) in metres, see ``surfaces``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import numpy as np
from pydantic import Field
from scipy.optimize import root_scalar

from asset_tools.builtin.mesh import Patch, Shape, Size, build_fitted_shape
from asset_tools.builtin.surfaces import (
    Section,
    loft,
    make_chained_pieces,
    make_circular_rings,
    make_oval_rings,
    make_prism_piece,
    make_stacked_pieces,
    sweep,
)

Ring = tuple[float, float, float, float, float]
Row = Annotated[Sequence[float], Field(min_length=2, max_length=5)]  # of a product's file, see ``bottle``


def make_bottle(
    size: Size,
    *,
    foot: tuple[float, float, float],
    side: Sequence[Row],
    shoulder: Sequence[Row],
    cap: Sequence[Row],
    cuts: Sequence[float],
) -> Shape:
    """Make a bottle from rings.

    A ring has five numbers, or two to four if it is round. Five numbers: half width, half depth and height as fractions
    of those of the bottle, exponent, and the length in m that is cut off to round the corner. Two to four numbers:
    radius in m, height as a fraction, cut-off length in m (default 0), exponent (default 2).

    Args:
        size: outer size (x, y, z), m.
        foot: half width and half depth of the rounded lower edge, as fractions of those of the bottle; exponent.
        side: rings of the side, from the bottom to the top.
        shoulder: rings of the shoulder.
        cap: rings of the cap.
        cuts: heights at which the profile is concave, as fractions of the height.
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


def make_flip_top_bottle(size: Size, *, exponent: float, cap_height: float, taper: float, waist: float) -> Shape:
    """Make an oval bottle with a waist and a wide oval cap.

    Args:
        size: outer size (x, y, z), m.
        exponent: exponent of the section, see ``surfaces``.
        cap_height: height of the cap as a fraction of the height.
        taper: width of the cap as a fraction of the width.
        waist: fraction by which the middle of the body is narrower.
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


def make_drink_bottle(size: Size) -> Shape:
    """Make a round bottle with a waist, long shoulders and a screw cap."""
    r, _, h = _halves(size)
    side = [_neck(r * 0.8, 0), _neck(r, 0, 0.008), _neck(r, h * 0.16, 0.004)]
    side += [_neck(r * 0.93, h * 0.2, 0.006), _neck(r * 0.93, h * 0.24, 0.006), _neck(r, h * 0.28, 0.004)]
    side += [_neck(r, h * 0.62)]
    shoulder = [_neck(r, h * 0.72, 0.04), _neck(0.0135, h * 0.88, 0.01), _neck(0.0135, h * 0.905)]
    cap = [_neck(0.0155, h * 0.905), _neck(0.0155, h, 0.0015), _neck(0.012, h)]
    # without the waist, which is only 2 mm deep, so that a lying bottle rests on one facet
    pieces = [
        make_prism_piece([(r * 0.86, 0), (r, 0.005), (r, h * 0.65)]),
        make_prism_piece([(r, h * 0.65), (r * 0.9, h * 0.73), (0.0135, h * 0.87)]),
        make_prism_piece([(0.0135, h * 0.87), (0.0135, h * 0.905)]),
        make_prism_piece([(0.0155, h * 0.905), (0.0155, h)]),
    ]
    return _bottle(size, side, shoulder, cap, pieces=pieces)


def make_pump_bottle(size: Size, *, exponent: float, body: float) -> Shape:
    """Make a bottle with a pump and a spout towards +x; regions: side, shoulder, cap, spout, bottom.

    Args:
        size: outer size (x, y, z), m.
        exponent: exponent of the section, see ``surfaces``.
        body: height of the straight part, as a fraction of the height.
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


def make_upended_bottle(size: Size) -> Shape:
    """Make a bottle that stands on its wide cap, with a domed top; regions: side, shoulder, cap, lid."""
    a, b, h = _halves(size)
    ca, cb, z = a * 0.74, b * 0.86, h * 0.15
    cap = [(ca * 0.94, cb * 0.94, 0, 2.6, 0), (ca, cb, 0, 2.6, 0.002), (ca, cb, z, 2.6, 0.001)]
    cap += [(ca * 0.96, cb * 0.95, z, 2.6, 0)]
    side = [cap[-1], (a * 0.80, b * 0.94, h * 0.3, 2.6, 0.05), (a, b, h * 0.74, 2.6, 0.04), (a, b, h * 0.88, 2.6, 0)]
    dome = [side[-1], (a * 0.97, b * 0.96, h * 0.985, 2.6, 0.018), (a * 0.55, b * 0.5, h, 2.4, 0.015), _neck(0, h)]
    part = loft(
        [
            Section("lid", make_oval_rings([_neck(0, 0), cap[0]]), flat=True, detail=0.5),
            Section("cap", make_oval_rings(cap), detail=0.5),
            Section("side", make_oval_rings(side, steps=3)),
            Section("shoulder", make_oval_rings(dome, steps=4), flat=False, detail=0.4),
        ]
    )
    return build_fitted_shape([part], size, pieces=make_stacked_pieces(part, [z, h * 0.34]))


def make_tube(size: Size, *, cap_radius: float, cap_height: float, flare: float = 1.0) -> Shape:
    """Make a squeeze tube that stands on its cap and is flat at the top; regions: side, cap, lid.

    As in a real tube, the circumference is constant: the flat end is pi / 2 times as wide as the round end.

    Args:
        size: outer size (x, y, z), m; y is the diameter of the round end.
        cap_radius: radius of the cap at the tube, m.
        cap_height: height of the cap, m.
        flare: radius of the cap at its base, as a factor of ``cap_radius``.
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
        Section("lid", make_circular_rings([(0, 0, 0), (foot * 0.9, 0, 0)]), flat=True, detail=0.5),
        Section("cap", make_circular_rings(cap), detail=0.6),
        Section("side", np.array(body)),
    ]
    part = loft(sections)
    return build_fitted_shape([part], size, pieces=make_stacked_pieces(part, [cap_height, start]))


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
    """Make a bottle from the rings of body, shoulder and cap; add a flat lid if the last ring is open.

    Args:
        size: outer size (x, y, z), m.
        side: rings of the body, from the bottom to the top.
        shoulder: rings of the shoulder, which continue the body.
        cap: rings of the cap, which continue the shoulder.
        cuts: heights at which the body is cut into convex collision pieces, m.
        pieces: points (k, 3) of each convex collision piece; None: from ``cuts``.
        spout: patches of the spout, a separate part; None: no spout.
    """
    a, b, _, n, _ = side[0]
    shoulder, cap = [(*side[-1][:4], 0), *shoulder], [(*shoulder[-1][:4], 0), *cap]
    bottom = [(0, 0, 0.003, n, 0), (a * 0.78, b * 0.74, 0.003, n, 0.004), side[0]]
    sections = [
        Section("bottom", make_oval_rings(bottom), flat=True, detail=0.4),
        Section("side", make_oval_rings(list(side), steps=3)),
        Section("shoulder", make_oval_rings(shoulder, steps=4), detail=0.4),
        Section("cap", make_oval_rings(cap, steps=3), detail=0.5),
    ]
    if cap[-1][0] > 0:
        lid = [cap[-1], (0, 0, *cap[-1][2:])]
        sections.append(Section("lid", make_oval_rings(lid), flat=True, detail=0.6))
    part = loft(sections)
    pieces = make_stacked_pieces(part, cuts) if pieces is None else pieces
    if spout is None:
        return build_fitted_shape([part], size, pieces=pieces)
    return build_fitted_shape([part, spout], size, pieces=pieces + make_chained_pieces(spout[0], 2))


def _halves(size: Size) -> tuple[float, float, float]:
    return size[0] / 2, size[1] / 2, size[2]


def _foot(a: float, b: float, exponent: float) -> list[Ring]:
    """Return the rings of the rounded lower edge of a body with half width ``a`` and half depth ``b``."""
    return [(a * 0.88, b * 0.86, 0, exponent, 0), (a, b, 0, exponent, 0.007)]


def _neck(radius: float, z: float, cut: float = 0.0) -> Ring:
    """Return a round ring with a radius and a height z, m; ``cut`` is cut off to round the corner."""
    return radius, radius, z, 2.0, cut


def _ellipse_perimeter(a: float, b: float) -> float:
    """Return the perimeter of an ellipse with radii a and b (Ramanujan's approximation)."""
    return np.pi * (3 * (a + b) - np.sqrt((3 * a + b) * (a + 3 * b)))
