"""Make boxes, cans, jars and mugs of a given size, as closed shapes with texture coordinates.

The centre of the bounding box is the origin. Shapes are upright, with the front towards -y. ``size`` is the outer size
(x, y, z) in metres. The docstrings name the regions of the texture. The region ``side`` is unrolled, and its middle is
the front.
"""

from __future__ import annotations

import numpy as np

from asset_tools.builtin.mesh import Shape, Size, build_fitted_shape
from asset_tools.builtin.surfaces import (
    Section,
    compute_ring_points,
    loft,
    make_chained_pieces,
    make_circular_rings,
    make_oval_rings,
    make_prism_piece,
    make_rounded_box,
    make_stacked_pieces,
    sweep,
)


def make_carton(size: Size, *, radius: float = 0.0012) -> Shape:
    """Make a cardboard box with rounded edges; regions: front, back, right, left, top, bottom."""
    return build_fitted_shape([make_rounded_box(size, radius, steps=1 if radius < 0.003 else 3)], size)


def make_soap_bar(size: Size) -> Shape:
    """Make a bar of soap, which lies flat; regions: top, side, bottom."""
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
        Section("bottom", make_oval_rings(low), flat=True),
        Section("side", make_oval_rings(side)),
        Section("top", make_oval_rings(high), flat=True),
    ]
    return build_fitted_shape([loft(sections, segments=32)], size)


def make_can(size: Size, *, exponent: float = 2.0) -> Shape:
    """Make a can with rims and recessed lids; regions: side, rim, lid, bottom.

    Args:
        size: outer size (x, y, z), m.
        exponent: exponent of the superellipse of the section: 2 is round, larger values are nearly rectangular.
    """
    a, b, h = size[0] / 2, size[1] / 2, size[2]
    rim, sunk = 0.004, 0.002

    def ring(inset: float, z: float, cut: float = 0.0) -> tuple[float, float, float, float, float]:
        return a - inset, b - inset, z, exponent, cut

    axis = (0.0, 0.0)
    low = [ring(rim, 0.0008), ring(0.002, 0), ring(0, 0, 0.001), ring(0, rim * 0.7, 0.0008), ring(0.001, rim)]
    high = [(*entry[:2], h - entry[2], *entry[3:]) for entry in reversed(low)]
    segments = 32 if exponent == 2.0 else 40
    sections = [
        Section(
            "bottom", make_oval_rings([(*axis, sunk, exponent, 0), ring(rim, sunk), low[0]]), flat=True, detail=0.6
        ),
        Section("rim", make_oval_rings(low, steps=2), detail=0.5),
        Section("side", make_oval_rings([low[-1], high[0]])),
        Section("rim", make_oval_rings(high, steps=2), detail=0.5),
        Section(
            "lid",
            make_oval_rings([high[-1], ring(rim, h - sunk), (*axis, h - sunk, exponent, 0)]),
            flat=True,
            detail=0.8,
        ),
    ]
    part = loft(sections, segments=segments)
    # few sides, since a can with 16 or 20 sides rolls for seconds after some drops
    pieces = [make_prism_piece([(a, 0), (a, h)], 12)] if exponent == 2.0 else make_stacked_pieces(part)
    return build_fitted_shape([part], size, pieces=pieces)


def make_canister(size: Size) -> Shape:
    """Make a tall cardboard tube with a plastic lid; regions: side, cap, lid, bottom."""
    r, h = size[0] / 2, size[2]
    body, lid = r - 0.0012, 0.014
    sections = [
        Section(
            "bottom",
            make_circular_rings([(0, 0.002, 0), (body - 0.003, 0.002, 0), (body - 0.002, 0, 0)]),
            flat=True,
            detail=0.4,
        ),
        Section("side", make_circular_rings([(body - 0.002, 0, 0), (body, 0, 0.002), (body, h - lid, 0)])),
        Section(
            "cap",
            make_circular_rings([(body, h - lid, 0), (r, h - lid, 0), (r, h - 0.001, 0.002), (r - 0.004, h, 0)]),
            detail=0.6,
        ),
        Section(
            "lid",
            make_circular_rings([(r - 0.004, h, 0), (r - 0.006, h - 0.002, 0), (0, h - 0.002, 0)]),
            flat=True,
            detail=0.6,
        ),
    ]
    part = loft(sections)
    return build_fitted_shape(
        [part], size, pieces=[make_prism_piece([(body, 0), (body, h - lid)]), make_prism_piece([(r, h - lid), (r, h)])]
    )


def make_jar(size: Size) -> Shape:
    """Make a glass jar with a wide screw lid; regions: side, cap, lid, bottom."""
    r, h = size[0] / 2, size[2]
    neck, lid = r * 0.90, h * 0.2
    side = [(r * 0.85, 0, 0), (r, 0, 0.006), (r, h - lid - 0.007, 0.007), (neck - 0.001, h - lid, 0)]
    cap = [(neck - 0.001, h - lid, 0), (neck + 0.0015, h - lid, 0.001), (neck + 0.0015, h, 0.003), (neck * 0.88, h, 0)]
    sections = [
        Section(
            "bottom",
            make_circular_rings([(0, 0.002, 0), (r * 0.7, 0.002, 0.004), (r * 0.85, 0, 0)]),
            flat=True,
            detail=0.4,
        ),
        Section("side", make_circular_rings(side)),
        Section("cap", make_circular_rings(cap), detail=0.7),
        Section(
            "lid",
            make_circular_rings([(neck * 0.88, h, 0), (neck * 0.84, h - 0.0012, 0), (0, h - 0.0012, 0)]),
            flat=True,
            detail=0.8,
        ),
    ]
    part = loft(sections)
    low = [(r * 0.88, 0), (r, 0.005), (r, h - lid - 0.003)]
    high = [(neck, h - lid - 0.003), (neck, h)]
    return build_fitted_shape([part], size, pieces=[make_prism_piece(low, 12), make_prism_piece(high, 12)])


def make_mug(size: Size, *, wall: float = 0.004) -> Shape:
    """Make a mug with a cavity and a handle towards +x; regions: side, inside, floor, bottom, handle.

    Args:
        size: outer size (x, y, z), m.
        wall: thickness of the wall, m.
    """
    r, h = size[1] / 2, size[2]
    inner, floor = r - wall, 0.006
    sections = [
        Section(
            "bottom",
            make_circular_rings([(0, 0.001, 0), (r * 0.75, 0.001, 0), (r * 0.8, 0, 0), (r * 0.88, 0, 0)]),
            flat=True,
            detail=0.4,
        ),
        Section("side", make_circular_rings([(r * 0.88, 0, 0), (r, 0, 0.006), (r, h, 0.0018), (r - wall / 2, h, 0)])),
        Section(
            "inside",
            make_circular_rings(
                [(r - wall / 2, h, 0), (inner, h, 0.0018), (inner, floor, 0.008), (inner * 0.7, floor, 0)]
            ),
            detail=0.4,
        ),
        Section("floor", make_circular_rings([(inner * 0.7, floor, 0), (0, floor, 0)]), flat=True, detail=0.3),
    ]
    reach = size[0] - r - 0.005  # largest x of the handle's centre line
    t = np.linspace(-0.5, 0.5, 19) * np.pi
    bow = np.sign(np.cos(t)) * np.abs(np.cos(t)) ** 0.75
    path = np.stack([r - wall * 0.55 + bow * (reach - r + wall * 0.55), 0 * t, h * 0.5 + np.sin(t) * h * 0.31], axis=-1)
    radii = np.full((len(t), 2), (0.0045, 0.0065))
    # flat ends inside the wall
    path, radii = np.concatenate([path[:1], path, path[-1:]]), np.concatenate([[[0, 0]], radii, [[0, 0]]])
    path[0, 0] -= 2e-4
    path[-1, 0] -= 2e-4
    handle = sweep("handle", path, radii, normal=(0, 1, 0), segments=12, detail=0.5)
    pieces = _ring_pieces(inner, r, (0.0, h), count=8)
    pieces.append(
        compute_ring_points(np.array([[inner, inner, z, 2.0] for z in (0.0, floor)]), 24)[:, :-1].reshape(-1, 3)
    )
    pieces += make_chained_pieces(handle[0], 4)
    return build_fitted_shape([loft(sections), handle], size, pieces=pieces)


def _ring_pieces(inner: float, outer: float, heights: tuple[float, float], *, count: int) -> list[np.ndarray]:
    """Return the points (k, 3) of ``count`` convex pieces of an upright pipe: arcs with flat inner sides.

    The flat sides are placed so that the mean inner radius is correct.

    Args:
        inner: inner radius, m.
        outer: outer radius, m.
        heights: lower and upper end, m.
        count: number of pieces.
    """
    pieces = []
    step = 2 * np.pi / count
    flat = inner * 2 / (1 + np.cos(step / 2))  # corners outside, middle inside the true wall by the same amount
    for angle in np.arange(count) * step:
        corners = [(outer, a) for a in np.linspace(angle, angle + step, 4)] + [(flat, angle + step), (flat, angle)]
        pieces.append(np.array([(q * np.cos(a), q * np.sin(a), z) for q, a in corners for z in heights]))
    return pieces
