"""Make movable square containers for tables: a wicker basket and an enamelled plate."""

from __future__ import annotations

from functools import partial

import numpy as np
import trimesh
from PIL import Image

from asset_tools.builtin.materials import Grid, Material, paint_plain, paint_wickerwork, paint_wrapped_rim
from asset_tools.builtin.mesh import Patch, Shape, build_shape
from asset_tools.builtin.surfaces import unroll_uv
from asset_tools.builtin.textures import Painter
from asset_tools.sources import FurnitureSource
from robocas_ms3.assets.manifest import InnerBox, Surface

BASKET_HEIGHT = 0.19
BASKET_ORIGIN = 0.096  # m, height of the frame above the bottom, as in RoboCAS-v0
PLATE_HEIGHT = 0.10
ROUNDING_STEPS = 3


def make_basket() -> FurnitureSource:
    """Make a red wicker basket, open at the top; the origin is 0.096 m above the bottom."""
    side = Material((1.2, 0.19), partial(paint_wickerwork, cell=(0.014, 0.01)))
    paints = {"rim": Material((1.2, 0.04), paint_wrapped_rim)} | dict.fromkeys(
        ("side", "inside", "floor", "bottom"), side
    )
    shape, pieces, floor, inside, top = _vessel(
        low=-BASKET_ORIGIN,
        height=BASKET_HEIGHT,
        half_bottom=0.138,
        half_top=0.15,
        wall=0.008,
        rim=0.015,
        corner=0.02,
    )
    return FurnitureSource(
        "basket",
        "basket",
        "container",
        _painted(shape, paints, dark=("inside", "floor", "bottom"), roughness=0.7),
        pieces,
        mass=0.8,
        origin_height=BASKET_ORIGIN,
        inner=InnerBox(min=(-inside, -inside, floor), max=(inside, inside, top)),
    )


def make_plate() -> FurnitureSource:
    """Make a deep, square, white plate with a blue rim, as large as in RoboCAS-v0.

    The origin is at its bottom.
    """
    white = Material((0.3, 0.3), partial(paint_plain, colour=(240, 240, 236)))
    paints = {"rim": Material((1.2, 0.02), partial(paint_plain, colour=(38, 62, 122)))}
    paints |= dict.fromkeys(("side", "inside", "floor", "bottom"), white)
    shape, pieces, floor, inside, top = _vessel(
        low=0.0, height=PLATE_HEIGHT, half_bottom=0.15, half_top=0.20, wall=0.006, rim=0.008, corner=0.03
    )
    return FurnitureSource(
        "plate",
        "plate",
        "plate",
        _painted(shape, paints, dark=(), roughness=0.3),
        pieces,
        mass=0.9,
        surfaces={"floor": Surface(min_xy=(-inside, -inside), max_xy=(inside, inside), z=floor)},
        inner=InnerBox(min=(-inside, -inside, floor), max=(inside, inside, top)),
    )


def _vessel(
    *, low: float, height: float, half_bottom: float, half_top: float, wall: float, rim: float, corner: float
) -> tuple[Shape, list[np.ndarray], float, float, float]:
    """Make a square container that widens upwards.

    Args:
        low: z of the bottom, m.
        height: height, m.
        half_bottom: half of the outer width at the bottom, m.
        half_top: half of the outer width at the top, m.
        wall: thickness of walls and floor, m.
        rim: height of the rim, m.
        corner: radius of the vertical edges, m.

    Returns:
        Shape, points (k, 3) of each collision piece, z of the inner floor, half of the inner width at the floor, and z
        of the top.
    """
    high, floor = low + height, low + wall
    flare = (half_top - half_bottom) / height

    def half(z: float) -> float:
        return half_bottom + flare * (z - low)

    def rows(region: str, *rings: tuple[float, float]) -> Patch:
        points = np.stack([_ring(size, z, corner) for size, z in rings])
        uv, size = unroll_uv(points)
        return Patch(region, points, uv, size)

    band = high - rim
    part = [
        _cap("bottom", half(low), low, corner, upward=False),
        rows("side", (half(low), low), (half(band), band)),
        rows("rim", (half(band), band), (half(high), high), (half(high) - wall, high), (half(band) - wall, band)),
        rows("inside", (half(band) - wall, band), (half(floor) - wall, floor)),
        _cap("floor", half(floor) - wall, floor, corner, upward=True),
    ]
    corners = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)], dtype=float)
    pieces = [np.array([(*(end * half(z)), z) for z in (low, floor) for end in corners])]
    for i in range(4):
        ends = corners[[i, (i + 1) % 4]]
        pieces.append(
            np.array([(*(end * (half(z) - inset)), z) for z in (floor, high) for inset in (0.0, wall) for end in ends])
        )
    return build_shape([part], texture_size=1024), pieces, floor, half(floor) - wall, high


def _painted(
    shape: Shape, materials: dict[str, Material], *, dark: tuple[str, ...], roughness: float
) -> trimesh.Trimesh:
    painter = Painter(shape, np.random.default_rng(7), (128, 128, 128))
    for name, region in shape.regions.items():
        left, top, right, bottom = region.box
        colours = materials[name].paint(Grid.from_size(region.size, (right - left, bottom - top)), painter.rng)
        painter.put_pixels(name, np.clip(colours * (0.8 if name in dark else 1.0), 0, 255).astype(np.uint8))
    return shape.make_textured_mesh(Image.fromarray(painter.pixels), roughness=roughness)


def _ring(half: float, z: float, corner: float) -> np.ndarray:
    """Return points (n, 3) around a square with rounded corners, counterclockwise.

    The last point is the first point.

    Args:
        half: half of the width of the square, m.
        z: height, m.
        corner: radius of the corners, m.
    """
    center = half - corner
    points = []
    for i, (sx, sy) in enumerate([(-1, 1), (-1, -1), (1, -1), (1, 1)]):
        for angle in np.pi / 2 * (1 + i + np.linspace(0, 1, ROUNDING_STEPS + 1)):
            points.append((sx * center + corner * np.cos(angle), sy * center + corner * np.sin(angle), z))
    middle = (0.0, half, z)
    return np.array([middle, *points, middle])


def _cap(region: str, half: float, z: float, corner: float, *, upward: bool) -> Patch:
    ring = _ring(half, z, corner)
    center = np.broadcast_to([0.0, 0.0, z], ring.shape)
    points = np.stack([ring, center] if upward else [center, ring])
    uv = points[..., :2] * ([1, 1] if upward else [-1, 1]) / (2 * half) + 0.5
    return Patch(region, points, uv, (2 * half, 2 * half), 0.6)
