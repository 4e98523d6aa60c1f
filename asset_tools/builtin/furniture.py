"""Builtin scenery: a room, a table, a basket; textured, with collision pieces that are convex one by one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import numpy as np
import trimesh
from PIL import Image

from asset_tools.builtin.materials import paint_basket, paint_room, paint_table
from asset_tools.builtin.mesh import Patch, Shape, build_shape
from asset_tools.builtin.surfaces import rounded_box, unrolled_uv
from robocas_ms3.assets.manifest import InnerBox, Surface

TEXTURE_SIZE = 1024

TABLE_HEIGHT = 0.61  # m
TABLE_HALF = (0.38, 0.68)
TABLE_THICKNESS = 0.03
LEG = 0.06
LEG_INSET = 0.03

BASKET_HEIGHT = 0.19
BASKET_ORIGIN = 0.096  # of the frame above the bottom
BASKET_HALF_TOP, BASKET_HALF_BOTTOM = 0.15, 0.138
BASKET_WALL = 0.008
BASKET_CORNER = 0.02  # radius of the visual mesh's upright edges
BASKET_MASS = 0.8

ROOM_HALF, ROOM_HEIGHT = 3.0, 4.0
ROOM_TILE = 1.5  # m: the floor's and ceiling's texture repeats
ROOM_PANEL = 2.0  # m: the walls' texture repeats
ROOM_SLAB = 0.1  # thickness of floor and walls, outside the room


@dataclass(frozen=True)
class Furniture:
    """A piece of scenery.

    Args:
        id: its folder's name. name: for language. category: its kind.
        shape: the visual surface, in the furniture's frame. paint: makes its texture.
        pieces: convex collision pieces, corner points (k, 3) each, m.
        mass: kg, None if it can't move. origin_height: of the frame above the lowest point, m.
        surfaces: where objects may stand. inner: the inside of a container.
        roughness: of the surface.
    """

    id: str
    name: str
    category: str
    shape: Shape
    paint: Callable[[Shape, np.random.Generator], Image.Image]
    pieces: list[np.ndarray]
    mass: float | None = None
    origin_height: float = 0.0
    surfaces: dict[str, Surface] = field(default_factory=dict)
    inner: InnerBox | None = None
    roughness: float = 0.7

    def textured(self) -> trimesh.Trimesh:
        """The textured mesh to render; the same every time."""
        return self.shape.textured(self.paint(self.shape, np.random.default_rng(7)), roughness=self.roughness)

    def mass_properties(self) -> tuple[np.ndarray, np.ndarray]:
        """Centre of mass (3,) m and moments about it (3,) kg m2, along the frame's axes, the pieces being solid.

        Raises:
            ValueError: it has no mass, or its principal axes are not the frame's.
        """
        if self.mass is None:
            raise ValueError(f"{self.id} can't move: it has no mass")
        hulls = [trimesh.convex.convex_hull(piece) for piece in self.pieces]
        volume = np.array([hull.volume for hull in hulls])
        masses = self.mass * volume / volume.sum()
        center = masses @ np.array([hull.center_mass for hull in hulls]) / self.mass
        inertia = np.zeros((3, 3))
        for hull, mass in zip(hulls, masses, strict=True):
            offset = hull.center_mass - center
            inertia += hull.moment_inertia * mass / hull.volume
            inertia += mass * (offset @ offset * np.eye(3) - np.outer(offset, offset))
        if np.abs(inertia - np.diag(np.diag(inertia))).max() > 1e-6 * np.trace(inertia):
            raise ValueError(f"{self.id}: its principal axes are not those of its frame")
        return center, np.diag(inertia)


def build_furniture() -> list[Furniture]:
    """All builtin furniture."""
    return [table(), basket(), room()]


def table() -> Furniture:
    """A wooden table: origin on the floor under its centre, top at 0.61 m."""
    half_x, half_y = TABLE_HALF
    slab = ((2 * half_x, 2 * half_y, TABLE_THICKNESS), (0.0, 0.0, TABLE_HEIGHT - TABLE_THICKNESS / 2))
    leg_height = TABLE_HEIGHT - TABLE_THICKNESS
    feet = [
        (sx * (half_x - LEG_INSET - LEG / 2), sy * (half_y - LEG_INSET - LEG / 2)) for sx in (-1, 1) for sy in (-1, 1)
    ]
    edge = {"front": "short", "back": "short", "left": "long", "right": "long", "bottom": "top"}
    parts = [rounded_box(slab[0], 0.004, steps=2, center=slab[1], regions=edge)]
    leg_sides = {name: "leg" for name in ("front", "back", "left", "right")} | {"top": "end", "bottom": "end"}
    for x, y in feet:  # a little into the slab, so that the union is one piece
        parts.append(
            rounded_box((LEG, LEG, leg_height + 0.01), 0.0, center=(x, y, leg_height / 2 + 0.005), regions=leg_sides)
        )
    pieces = [_box_points(*slab)] + [_box_points((LEG, LEG, leg_height), (x, y, leg_height / 2)) for x, y in feet]
    top = Surface(min_xy=(-half_x, -half_y), max_xy=(half_x, half_y), z=TABLE_HEIGHT)
    shape = build_shape(parts, texture_size=TEXTURE_SIZE)
    return Furniture("table", "table", "table", shape, paint_table, pieces, surfaces={"top": top}, roughness=0.55)


def basket() -> Furniture:
    """A red woven basket, open on top, a free body; its origin lies 0.096 m above its bottom."""
    low, high = -BASKET_ORIGIN, BASKET_HEIGHT - BASKET_ORIGIN
    floor = low + BASKET_WALL
    flare = (BASKET_HALF_TOP - BASKET_HALF_BOTTOM) / BASKET_HEIGHT

    def half(z: float) -> float:
        return BASKET_HALF_BOTTOM + flare * (z - low)

    rim = 0.015  # height of the plain band on top

    def rows(region: str, *rings: tuple[float, float]) -> Patch:
        points = np.stack([_square_ring(size, z) for size, z in rings])
        uv, size = unrolled_uv(points)
        return Patch(region, points, uv, size)

    wall = BASKET_WALL
    part = [
        _square_cap("bottom", half(low), low, upward=False),
        rows("side", (half(low), low), (half(high - rim), high - rim)),
        rows(
            "rim",
            (half(high - rim), high - rim),
            (half(high), high),
            (half(high) - wall, high),
            (half(high - rim) - wall, high - rim),
        ),
        rows("inside", (half(high - rim) - wall, high - rim), (half(floor) - wall, floor)),
        _square_cap("floor", half(floor) - wall, floor, upward=True),
    ]
    corners = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)], dtype=float)
    plate = [(*(corner * half(z)), z) for z in (low, floor) for corner in corners]
    pieces = [np.array(plate)]
    for i in range(4):
        ends = corners[[i, (i + 1) % 4]]
        pieces.append(
            np.array([(*(end * (half(z) - inset)), z) for z in (floor, high) for inset in (0.0, wall) for end in ends])
        )
    inside = half(floor) - wall
    return Furniture(
        "basket",
        "basket",
        "container",
        build_shape([part], texture_size=TEXTURE_SIZE),
        partial(paint_basket, height=BASKET_HEIGHT),
        pieces,
        mass=BASKET_MASS,
        origin_height=BASKET_ORIGIN,
        inner=InnerBox(min=(-inside, -inside, floor), max=(inside, inside, high)),
    )


def room() -> Furniture:
    """A room of 6 x 6 x 4 m around the world's origin, seen from inside; it has no door."""
    half, height, tile, panel = ROOM_HALF, ROOM_HEIGHT, ROOM_TILE, ROOM_PANEL
    patches = []
    steps = np.arange(-half, half - 1e-9, tile)
    for x in steps:
        for y in steps:
            patches.append(_quad("floor", (x, y, 0), (tile, 0, 0), (0, tile, 0), 1.0))
            patches.append(_quad("ceiling", (x, y, height), (0, tile, 0), (tile, 0, 0), 0.35))
    for turn in range(4):  # the back wall (+y) and its turns about z
        angle = turn * np.pi / 2
        right = np.array([round(np.cos(angle)), round(np.sin(angle)), 0.0])
        back = np.array([-right[1], right[0], 0.0])
        for s in np.arange(-half, half - 1e-9, panel):
            patches.append(_quad("wall", back * half + right * s, right * panel, (0, 0, height), 0.5))
    outer, slab = half + ROOM_SLAB, ROOM_SLAB
    pieces = [_box_points((2 * outer, 2 * outer, slab), (0, 0, -slab / 2))]
    for x, y in ((1, 0), (0, 1), (-1, 0), (0, -1)):
        size = (slab, 2 * outer, height) if x else (2 * outer, slab, height)
        pieces.append(_box_points(size, (x * (half + slab / 2), y * (half + slab / 2), height / 2)))
    floor = Surface(min_xy=(-half, -half), max_xy=(half, half), z=0.0)
    shape = build_shape([patches], texture_size=TEXTURE_SIZE)
    return Furniture("room", "room", "room", shape, paint_room, pieces, surfaces={"floor": floor}, roughness=0.8)


def _box_points(size: tuple[float, float, float], center: tuple[float, float, float]) -> np.ndarray:
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    return signs * np.asarray(size) / 2 + np.asarray(center)


def _quad(region: str, corner, right, up, detail: float) -> Patch:
    """A rectangle from its lower left corner (3,) and its sides (3,), seen from its front."""
    corner, right, up = (np.asarray(v, dtype=float) for v in (corner, right, up))
    points = np.array([[corner, corner + right], [corner + up, corner + right + up]])
    uv = np.array([[(0.0, 0.0), (1.0, 0.0)], [(0.0, 1.0), (1.0, 1.0)]])
    return Patch(region, points, uv, (float(np.linalg.norm(right)), float(np.linalg.norm(up))), detail)


def _square_ring(half: float, z: float, steps: int = 3) -> np.ndarray:
    """Points (n, 3) around a square with rounded corners, closed, from the middle of the back counterclockwise."""
    center = half - BASKET_CORNER
    points = []
    for i, (sx, sy) in enumerate([(-1, 1), (-1, -1), (1, -1), (1, 1)]):
        for angle in np.pi / 2 * (1 + i + np.linspace(0, 1, steps + 1)):
            points.append((sx * center + BASKET_CORNER * np.cos(angle), sy * center + BASKET_CORNER * np.sin(angle), z))
    middle = (0.0, half, z)
    return np.array([middle, *points, middle])


def _square_cap(region: str, half: float, z: float, *, upward: bool) -> Patch:
    ring = _square_ring(half, z)
    center = np.broadcast_to([0.0, 0.0, z], ring.shape)
    points = np.stack([ring, center] if upward else [center, ring])
    uv = points[..., :2] * ([1, 1] if upward else [-1, 1]) / (2 * half) + 0.5
    return Patch(region, points, uv, (2 * half, 2 * half), 0.6)
