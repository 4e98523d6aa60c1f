"""Make three tables: an oak table, a dining table, and a round table of marble and steel."""

from __future__ import annotations

import numpy as np

from asset_tools.builtin.furniture.base import Body, make_disc_corners, make_surface
from asset_tools.builtin.materials import BLACK_STEEL, OAK, WALNUT, WHITE, Material, make_wood, paint_marble
from asset_tools.sources import FurnitureSource

TABLE_HEIGHT = 0.61  # m, as in RoboCAS-v0
TABLE_HALF = (0.38, 0.68)
DINING_HEIGHT = 0.75
DINING_HALF = (0.42, 0.80)
SIDE_HEIGHT = 0.50
SIDE_RADIUS = 0.46


def make_table() -> FurnitureSource:
    """Make an oak table with square legs, 0.61 m high; the origin is on the floor below the centre."""
    (x, y), z, thickness, leg = TABLE_HALF, TABLE_HEIGHT, 0.03, 0.06
    body = Body(
        {"top": make_wood(OAK, (1.37, 0.77), plank=0.1283), "oak": make_wood(OAK, (1.25, 0.16))}, roughness=0.55
    )
    body.add_board((-x, -y, z - thickness), (x, y, z), "top", bevel=0.003)
    _legs(body, "oak", x - 0.03, y - 0.03, leg, z - thickness)
    _apron(body, "oak", x - 0.045, y - 0.045, leg, z - thickness, 0.07)
    return FurnitureSource(
        "table", "table", "table", body.make_mesh(), body.pieces, surfaces={"top": make_surface((-x, -y), (x, y), z)}
    )


def make_dining_table() -> FurnitureSource:
    """Make a table with a walnut top and white tapered legs, 0.75 m high."""
    (x, y), z, thickness = DINING_HALF, DINING_HEIGHT, 0.035
    body = Body({"top": make_wood(WALNUT, (1.62, 0.86), plank=0.1433), "white": WHITE}, seed=1, roughness=0.5)
    body.add_board((-x, -y, z - thickness), (x, y, z), "top", bevel=0.006)
    below = z - thickness
    for sx in (-1, 1):
        for sy in (-1, 1):
            inner = np.array([sx * (x - 0.10), sy * (y - 0.10), 0.0])
            outer = inner + (sx * 0.07, sy * 0.07, 0)
            knee = np.array([0, 0, below - 0.13])
            body.add_board(inner + knee, outer + (0, 0, below), "white", bevel=0.002)
            foot = outer - (sx * 0.035, sy * 0.035, 0)
            body.add_solid(np.concatenate([_square(inner + knee, outer + knee), _square(foot, outer)]), "white")
    _apron(body, "white", x - 0.04, y - 0.04, 0.06, below, 0.09)
    return FurnitureSource(
        "dining_table",
        "dining table",
        "table",
        body.make_mesh(),
        body.pieces,
        surfaces={"top": make_surface((-x, -y), (x, y), z)},
    )


def make_side_table() -> FurnitureSource:
    """Make a round table with a paint_marble top and black steel legs, 0.5 m high.

    Its supporting surface is the square inscribed in the top.
    """
    z, radius, thickness = SIDE_HEIGHT, SIDE_RADIUS, 0.025
    body = Body({"top": Material((0.94, 0.94), paint_marble), "steel": BLACK_STEEL}, seed=2, roughness=0.35)
    body.add_solid(make_disc_corners((0, 0, z - thickness), radius, thickness, bevel=0.003), "top", collide=False)
    body.add_solid(make_disc_corners((0, 0, z - thickness), radius, thickness), "top", show=False)
    bar, reach = 0.022, 0.30
    for sx in (-1, 1):
        for sy in (-1, 1):  # legs that lean outwards
            head, foot = np.array([sx * 0.19, sy * 0.19, z - thickness]), np.array([sx * reach, sy * reach, 0.0])
            half = np.array([bar / 2, bar / 2, 0])
            body.add_solid(np.concatenate([_square(end - half, end + half) for end in (head, foot)]), "steel")
    level = 0.12
    spread = 0.19 + (reach - 0.19) * (1 - level / (z - thickness))
    for side in (-1, 1):  # a frame near the floor, and one below the top
        for height, half in ((level, spread), (z - thickness - bar / 2, 0.19)):
            body.add_board(
                (-half, side * half - bar / 2, height - bar / 2),
                (half, side * half + bar / 2, height + bar / 2),
                "steel",
            )
            body.add_board(
                (side * half - bar / 2, -half, height - bar / 2),
                (side * half + bar / 2, half, height + bar / 2),
                "steel",
            )
    half = 0.32
    return FurnitureSource(
        "side_table",
        "side table",
        "table",
        body.make_mesh(),
        body.pieces,
        surfaces={"top": make_surface((-half, -half), (half, half), z)},
    )


def _square(corner: np.ndarray, opposite: np.ndarray) -> np.ndarray:
    """Return the corners (4, 3) of a horizontal rectangle, given by opposite corners.

    The height of the rectangle is the z of ``corner``.
    """
    return np.array([(x, y, corner[2]) for x in (corner[0], opposite[0]) for y in (corner[1], opposite[1])])


def _legs(body: Body, material: str, x: float, y: float, width: float, height: float) -> None:
    for sx in (-1, 1):
        for sy in (-1, 1):
            body.add_board((sx * x, sy * y, 0), (sx * (x - width), sy * (y - width), height), material, bevel=0.002)


def _apron(body: Body, material: str, x: float, y: float, leg: float, top: float, depth: float) -> None:
    """Add four vertical boards below the top, between the legs.

    Args:
        body: body of the table.
        material: name of the material.
        x: x of the outer face of the front board, m.
        y: y of the outer face of the side board, m.
        leg: width of the legs, m.
        top: z of the upper edge, m.
        depth: height of the boards, m.
    """
    board = 0.02
    for side in (-1, 1):
        body.add_board((side * x, -y + leg / 2, top - depth), (side * (x - board), y - leg / 2, top), material)
        body.add_board((-x + leg / 2, side * y, top - depth), (x - leg / 2, side * (y - board), top), material)
