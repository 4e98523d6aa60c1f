"""Parametric bottles and tubes, see ``shapes``."""

from __future__ import annotations

import numpy as np
from scipy.optimize import root_scalar

from asset_tools.builtin.mesh import Shape, Size, fitted
from asset_tools.builtin.surfaces import Section, chained_pieces, loft, oval_rings, round_rings, stacked_pieces, sweep


def squeeze_bottle(size: Size) -> Shape:
    """A flat oval bottle with a conical nozzle. Regions: side, shoulder, cap, bottom."""
    a, b, h = size[0] / 2, size[1] / 2, size[2]
    top = h * 0.70
    side = [
        (a * 0.88, b * 0.86, 0, 2.6, 0),
        (a, b, 0, 2.6, 0.008),
        (a * 0.97, b * 0.97, h * 0.3, 2.6, 0.05),
        (a, b, top, 2.6, 0),
    ]
    shoulder = [(a, b, top, 2.6, 0), (a * 0.98, b * 0.98, h * 0.76, 2.5, 0.02), (0.019, 0.019, h * 0.835, 2.0, 0)]
    cap = [
        (0.019, 0.019, h * 0.835, 2, 0),
        (0.021, 0.021, h * 0.835, 2, 0),
        (0.021, 0.021, h * 0.88, 2, 0.002),
        (0.0105, 0.0105, h * 0.9, 2, 0.006),
    ]
    cap += [(0.0055, 0.0055, h * 0.992, 2, 0.002), (0.004, 0.004, h, 2, 0.002), (0, 0, h, 2, 0)]
    sections = [
        Section(
            "bottom",
            oval_rings([(0, 0, 0.003, 2.6, 0), (a * 0.7, b * 0.66, 0.003, 2.6, 0.004), side[0]]),
            flat=True,
            detail=0.4,
        ),
        Section("side", oval_rings(side)),
        Section("shoulder", oval_rings(shoulder, steps=4), detail=0.4),
        Section("cap", oval_rings(cap), detail=0.6),
    ]
    part = loft(sections)
    return fitted([part], size, pieces=stacked_pieces(part, [h * 0.835, h * 0.9]))


def flip_top_bottle(size: Size, *, exponent: float = 2.4, cap_height: float = 0.2, taper: float = 0.82) -> Shape:
    """An oval bottle with a wide cap as its shoulders' continuation. Regions: side, shoulder, cap, lid, bottom."""
    a, b, h = size[0] / 2, size[1] / 2, size[2]
    cap_z, shoulder_z = h * (1 - cap_height), h * (0.88 - cap_height)
    ca, cb = a * taper * 0.7, b * taper
    side = [(a * 0.88, b * 0.86, 0, exponent, 0), (a, b, 0, exponent, 0.006), (a, b, shoulder_z, exponent, 0)]
    shoulder = [
        (a, b, shoulder_z, exponent, 0),
        (a, b, shoulder_z + 0.3 * (cap_z - shoulder_z), exponent, 0.02),
        (ca, cb * 0.96, cap_z, 2.2, 0),
    ]
    cap = [
        (ca, cb * 0.96, cap_z, 2.2, 0),
        (ca + 0.0012, cb, cap_z, 2.2, 0),
        (ca * 0.96, cb * 0.96, h, 2.2, 0.003),
        (ca * 0.8, cb * 0.8, h, 2.2, 0),
    ]
    sections = [
        Section(
            "bottom",
            oval_rings([(0, 0, 0.002, exponent, 0), (a * 0.7, b * 0.66, 0.002, exponent, 0.004), side[0]]),
            flat=True,
            detail=0.4,
        ),
        Section("side", oval_rings(side)),
        Section("shoulder", oval_rings(shoulder, steps=4), detail=0.4),
        Section("cap", oval_rings(cap), detail=0.6),
        Section("lid", oval_rings([cap[-1], (0, 0, h, 2.2, 0)]), flat=True, detail=0.6),
    ]
    part = loft(sections)
    return fitted([part], size, pieces=stacked_pieces(part, [cap_z]))


def drink_bottle(size: Size) -> Shape:
    """A round bottle with waist, long shoulders and a screw cap. Regions: side, shoulder, cap, lid, bottom."""
    r, h = size[0] / 2, size[2]
    side = [
        (r * 0.8, 0, 0),
        (r, 0, 0.008),
        (r, h * 0.16, 0.004),
        (r * 0.93, h * 0.2, 0.006),
        (r * 0.93, h * 0.24, 0.006),
        (r, h * 0.28, 0.004),
        (r, h * 0.62, 0),
    ]
    shoulder = [(r, h * 0.62, 0), (r, h * 0.72, 0.04), (0.0135, h * 0.88, 0.01), (0.0135, h * 0.905, 0)]
    cap = [(0.0135, h * 0.905, 0), (0.0155, h * 0.905, 0), (0.0155, h, 0.0015), (0.012, h, 0)]
    sections = [
        Section(
            "bottom", round_rings([(0, 0.005, 0), (r * 0.6, 0.003, 0.008), (r * 0.8, 0, 0)]), flat=True, detail=0.4
        ),
        Section("side", round_rings(side)),
        Section("shoulder", round_rings(shoulder, steps=4), detail=0.4),
        Section("cap", round_rings(cap), detail=0.6),
        Section("lid", round_rings([(0.012, h, 0), (0, h, 0)]), flat=True, detail=0.6),
    ]
    part = loft(sections)
    return fitted([part], size, pieces=stacked_pieces(part, [h * 0.22, h * 0.87, h * 0.905]))


def screw_cap_bottle(size: Size) -> Shape:
    """A nearly rectangular bottle with a tall screw cap. Regions: side, shoulder, cap, lid, bottom."""
    a, b, h = size[0] / 2, size[1] / 2, size[2]
    side = [(a * 0.86, b * 0.84, 0, 4, 0), (a, b, 0, 4, 0.006), (a, b, h * 0.6, 4, 0)]
    shoulder = [
        (a, b, h * 0.6, 4, 0),
        (a, b, h * 0.7, 4, 0.022),
        (0.016, 0.016, h * 0.77, 2, 0.004),
        (0.0155, 0.0155, h * 0.80, 2, 0),
    ]
    cap = [
        (0.0155, 0.0155, h * 0.8, 2, 0),
        (0.0195, 0.0195, h * 0.8, 2, 0),
        (0.018, 0.018, h, 2, 0.002),
        (0.014, 0.014, h, 2, 0),
    ]
    sections = [
        Section(
            "bottom",
            oval_rings([(0, 0, 0.003, 4, 0), (a * 0.66, b * 0.6, 0.003, 4, 0.004), side[0]]),
            flat=True,
            detail=0.4,
        ),
        Section("side", oval_rings(side)),
        Section("shoulder", oval_rings(shoulder, steps=4), detail=0.4),
        Section("cap", oval_rings(cap), detail=0.6),
        Section("lid", oval_rings([cap[-1], (0, 0, h, 2, 0)]), flat=True, detail=0.6),
    ]
    part = loft(sections)
    return fitted([part], size, pieces=stacked_pieces(part, [h * 0.77, h * 0.8]))


def pump_bottle(size: Size) -> Shape:
    """A rounded bottle with a pump, its spout towards +x. Regions: side, shoulder, cap, spout, bottom."""
    a, b, h = size[0] / 2, size[1] / 2, size[2]
    body = h * 0.66
    side = [(a * 0.86, b * 0.84, 0, 3, 0), (a, b, 0, 3, 0.006), (a, b, body, 3, 0)]
    shoulder = [
        (a, b, body, 3, 0),
        (a, b, h * 0.73, 3, 0.02),
        (0.0145, 0.0145, h * 0.765, 2, 0.002),
        (0.0135, 0.0135, h * 0.77, 2, 0),
    ]
    cap = [
        (0.0135, 0.0135, h * 0.77, 2, 0),
        (0.016, 0.016, h * 0.77, 2, 0),
        (0.0155, 0.0155, h * 0.85, 2, 0.002),
        (0.006, 0.006, h * 0.855, 2, 0.001),
    ]
    cap += [
        (0.005, 0.005, h * 0.93, 2, 0.001),
        (0.0135, 0.0115, h * 0.935, 2.4, 0.002),
        (0.0145, 0.0125, h, 2.4, 0.004),
        (0, 0, h, 2.2, 0),
    ]
    sections = [
        Section(
            "bottom",
            oval_rings([(0, 0, 0.002, 3, 0), (a * 0.66, b * 0.6, 0.002, 3, 0.004), side[0]]),
            flat=True,
            detail=0.4,
        ),
        Section("side", oval_rings(side)),
        Section("shoulder", oval_rings(shoulder, steps=4), detail=0.4),
        Section("cap", oval_rings(cap, steps=3), detail=0.5),
    ]
    t = np.linspace(0, 1, 7)
    path = np.stack([0.004 + (a - 0.006) * t, 0 * t, h * 0.972 - 0.009 * t**3], axis=-1)
    radii = np.stack([0.0048 - 0.0014 * t, 0.0062 - 0.0024 * t], axis=-1)
    path, radii = np.concatenate([path[:1], path, path[-1:]]), np.concatenate([[[0, 0]], radii, [[0, 0]]])
    path[0, 0] -= 1e-4
    path[-1, 0] += 1e-4
    spout = sweep("spout", path, radii, normal=(0, 1, 0), segments=10, detail=0.5)
    part = loft(sections)
    pieces = stacked_pieces(part, [h * 0.765, h * 0.855, h * 0.93]) + chained_pieces(spout[0], 2)
    return fitted([part, spout], size, pieces=pieces)


def tube(size: Size, *, cap_radius: float, cap_height: float) -> Shape:
    """A squeeze tube standing on its cap: round there, blending into a flat crimp on top. Regions: side, cap, lid.

    Its circumference is the same all along, as of a real tube: the crimp is pi / 2 times as wide as the round end.
    """
    r, h, thick = size[1] / 2, size[2], 0.0008
    perimeter = 2 * np.pi * r

    def half_x(half_y: float) -> float:
        return root_scalar(lambda x: _ellipse_perimeter(x, half_y) - perimeter, bracket=(half_y * 0.99, np.pi * r)).root

    start, crimp = cap_height + 0.007, h - 0.008
    body = [(cap_radius, cap_radius, cap_height, 2.0), (r * 0.96, r * 0.96, start - 0.001, 2.0)]
    for fraction in np.linspace(0, 1, 11):
        half_y = r + (thick - r) * fraction**1.25
        body.append((half_x(half_y), half_y, start + (crimp - start) * fraction, 2.0))
    flat = body[-1][0]
    body += [(flat, thick, h - 0.0005, 2.0), (flat, 0.0, h, 2.0)]
    cap = [
        (cap_radius * 0.9, 0, 0),
        (cap_radius, 0, 0.002),
        (cap_radius, cap_height, 0.001),
        (cap_radius * 0.97, cap_height, 0),
    ]
    body.insert(0, (cap_radius * 0.97, cap_radius * 0.97, cap_height, 2.0))
    sections = [
        Section("lid", round_rings([(0, 0, 0), (cap_radius * 0.9, 0, 0)]), flat=True, detail=0.5),
        Section("cap", round_rings(cap), detail=0.6),
        Section("side", np.array(body)),
    ]
    part = loft(sections)
    return fitted([part], size, pieces=stacked_pieces(part, [cap_height, start]))


def _ellipse_perimeter(a: float, b: float) -> float:
    """Ramanujan's approximation."""
    return np.pi * (3 * (a + b) - np.sqrt((3 * a + b) * (a + 3 * b)))
