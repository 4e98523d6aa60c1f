"""Parametric boxes, tins, jars and mugs: each function returns a closed, UV-mapped ``Shape`` of exactly its size.

All are centred on the origin (middle of the bounding box), upright, front towards -y; sizes are (x, y, z) in metres.
The docstrings name the texture regions; ``side`` regions are unrolled with the front in their middle.
"""

from __future__ import annotations

import numpy as np

from asset_tools.builtin.mesh import Shape, Size, fitted
from asset_tools.builtin.surfaces import (
    Section,
    chained_pieces,
    loft,
    oval_rings,
    prism_piece,
    ring_points,
    round_rings,
    rounded_box,
    stacked_pieces,
    sweep,
)


def carton(size: Size, *, radius: float = 0.0012) -> Shape:
    """A cardboard box. Regions: front, back, right, left, top, bottom."""
    return fitted([rounded_box(size, radius, steps=1 if radius < 0.003 else 3)], size)


def soap_bar(size: Size) -> Shape:
    """A pillow-like bar lying flat. Regions: top, side, bottom."""
    a, b, h = size[0] / 2, size[1] / 2, size[2] / 2
    corner = [(a * 0.72, b * 0.6, -h, 3.0), (a * 0.93, b * 0.9, -h * 0.72, 3.2), (a, b, 0, 3.4)]
    low = [(0, 0, -h * 1.04, 2.6, 0), (*corner[0], 0.004), (*corner[1], 0)]
    side = [(*corner[1], 0), (*corner[2], 0.006), (corner[1][0], corner[1][1], h * 0.72, 3.2, 0)]
    high = [
        (corner[1][0], corner[1][1], h * 0.72, 3.2, 0),
        (corner[0][0], corner[0][1], h, 3.0, 0.004),
        (0, 0, h * 1.04, 2.6, 0),
    ]
    sections = [
        Section("bottom", oval_rings(low), flat=True),
        Section("side", oval_rings(side)),
        Section("top", oval_rings(high), flat=True),
    ]
    return fitted([loft(sections, segments=32)], size)


def can(size: Size, *, exponent: float = 2.0) -> Shape:
    """A tin with rims and sunk lids, round or (exponent > 2) rectangular. Regions: side, rim, lid, bottom."""
    a, b, h = size[0] / 2, size[1] / 2, size[2]
    rim, sunk = 0.004, 0.002

    def ring(inset: float, z: float, cut: float = 0.0) -> tuple[float, float, float, float, float]:
        return a - inset, b - inset, z, exponent, cut

    axis = (0.0, 0.0)
    low = [ring(rim, 0.0008), ring(0.002, 0), ring(0, 0, 0.001), ring(0, rim * 0.7, 0.0008), ring(0.001, rim)]
    high = [(*entry[:2], h - entry[2], *entry[3:]) for entry in reversed(low)]
    segments = 32 if exponent == 2.0 else 40
    sections = [
        Section("bottom", oval_rings([(*axis, sunk, exponent, 0), ring(rim, sunk), low[0]]), flat=True, detail=0.6),
        Section("rim", oval_rings(low, steps=2), detail=0.5),
        Section("side", oval_rings([low[-1], high[0]])),
        Section("rim", oval_rings(high, steps=2), detail=0.5),
        Section(
            "lid", oval_rings([high[-1], ring(rim, h - sunk), (*axis, h - sunk, exponent, 0)]), flat=True, detail=0.8
        ),
    ]
    part = loft(sections, segments=segments)
    # few sides: with 16 or 20, some drops roll on for seconds
    pieces = [prism_piece([(a, 0), (a, h)], 12)] if exponent == 2.0 else stacked_pieces(part)
    return fitted([part], size, pieces=pieces)


def canister(size: Size) -> Shape:
    """A tall cardboard tube with a plastic lid. Regions: side, cap, lid, bottom."""
    r, h = size[0] / 2, size[2]
    body, lid = r - 0.0012, 0.014
    sections = [
        Section(
            "bottom",
            round_rings([(0, 0.002, 0), (body - 0.003, 0.002, 0), (body - 0.002, 0, 0)]),
            flat=True,
            detail=0.4,
        ),
        Section("side", round_rings([(body - 0.002, 0, 0), (body, 0, 0.002), (body, h - lid, 0)])),
        Section(
            "cap",
            round_rings([(body, h - lid, 0), (r, h - lid, 0), (r, h - 0.001, 0.002), (r - 0.004, h, 0)]),
            detail=0.6,
        ),
        Section(
            "lid", round_rings([(r - 0.004, h, 0), (r - 0.006, h - 0.002, 0), (0, h - 0.002, 0)]), flat=True, detail=0.6
        ),
    ]
    part = loft(sections)
    return fitted([part], size, pieces=[prism_piece([(body, 0), (body, h - lid)]), prism_piece([(r, h - lid), (r, h)])])


def jar(size: Size) -> Shape:
    """A glass jar with a wide screw lid. Regions: side, cap, lid, bottom."""
    r, h = size[0] / 2, size[2]
    neck, lid = r * 0.90, h * 0.2
    side = [(r * 0.85, 0, 0), (r, 0, 0.006), (r, h - lid - 0.007, 0.007), (neck - 0.001, h - lid, 0)]
    cap = [(neck - 0.001, h - lid, 0), (neck + 0.0015, h - lid, 0.001), (neck + 0.0015, h, 0.003), (neck * 0.88, h, 0)]
    sections = [
        Section(
            "bottom", round_rings([(0, 0.002, 0), (r * 0.7, 0.002, 0.004), (r * 0.85, 0, 0)]), flat=True, detail=0.4
        ),
        Section("side", round_rings(side)),
        Section("cap", round_rings(cap), detail=0.7),
        Section(
            "lid",
            round_rings([(neck * 0.88, h, 0), (neck * 0.84, h - 0.0012, 0), (0, h - 0.0012, 0)]),
            flat=True,
            detail=0.8,
        ),
    ]
    part = loft(sections)
    low = [(r * 0.88, 0), (r, 0.005), (r, h - lid - 0.003)]
    high = [(neck, h - lid - 0.003), (neck, h)]
    return fitted([part], size, pieces=[prism_piece(low, 12), prism_piece(high, 12)])


def mug(size: Size, *, wall: float = 0.004) -> Shape:
    """A mug with a cavity and a handle towards +x. Regions: side, inside, floor, bottom, handle."""
    r, h = size[1] / 2, size[2]
    inner, floor = r - wall, 0.006
    sections = [
        Section(
            "bottom",
            round_rings([(0, 0.001, 0), (r * 0.75, 0.001, 0), (r * 0.8, 0, 0), (r * 0.88, 0, 0)]),
            flat=True,
            detail=0.4,
        ),
        Section("side", round_rings([(r * 0.88, 0, 0), (r, 0, 0.006), (r, h, 0.0018), (r - wall / 2, h, 0)])),
        Section(
            "inside",
            round_rings([(r - wall / 2, h, 0), (inner, h, 0.0018), (inner, floor, 0.008), (inner * 0.7, floor, 0)]),
            detail=0.4,
        ),
        Section("floor", round_rings([(inner * 0.7, floor, 0), (0, floor, 0)]), flat=True, detail=0.3),
    ]
    reach = size[0] - r - 0.005  # the handle's centre line, outermost
    t = np.linspace(-0.5, 0.5, 19) * np.pi
    bow = np.sign(np.cos(t)) * np.abs(np.cos(t)) ** 0.75
    path = np.stack([r - wall * 0.55 + bow * (reach - r + wall * 0.55), 0 * t, h * 0.5 + np.sin(t) * h * 0.31], axis=-1)
    radii = np.full((len(t), 2), (0.0045, 0.0065))
    # Flat ends inside the wall.
    path, radii = np.concatenate([path[:1], path, path[-1:]]), np.concatenate([[[0, 0]], radii, [[0, 0]]])
    path[0, 0] -= 2e-4
    path[-1, 0] -= 2e-4
    handle = sweep("handle", path, radii, normal=(0, 1, 0), segments=12, detail=0.5)
    pieces = _ring_pieces(inner, r, (0.0, h), count=8)
    pieces.append(ring_points(np.array([[inner, inner, z, 2.0] for z in (0.0, floor)]), 24)[:, :-1].reshape(-1, 3))
    pieces += chained_pieces(handle[0], 4)
    return fitted([loft(sections), handle], size, pieces=pieces)


def _ring_pieces(inner: float, outer: float, heights: tuple[float, float], *, count: int) -> list[np.ndarray]:
    """Convex pieces (k, 3) of an upright pipe: arcs whose inner sides are flat, the gap's volume shared out."""
    pieces = []
    step = 2 * np.pi / count
    flat = inner * 2 / (1 + np.cos(step / 2))  # corners outside, middle inside the true wall by the same amount
    for angle in np.arange(count) * step:
        corners = [(outer, a) for a in np.linspace(angle, angle + step, 4)] + [(flat, angle + step), (flat, angle)]
        pieces.append(np.array([(q * np.cos(a), q * np.sin(a), z) for q, a in corners for z in heights]))
    return pieces
