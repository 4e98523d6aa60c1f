"""Make a shop shelf with four layers of oak boards, black steel posts, a white back and price rails."""

from __future__ import annotations

from asset_tools.builtin.furniture.base import Body, make_surface
from asset_tools.builtin.materials import BLACK_STEEL, OAK, WHITE, make_coating, make_wood
from asset_tools.sources import FurnitureSource

LAYERS = (0.085, 0.514, 0.942, 1.371)  # m, as in RoboCAS-v0
TOP = 1.80
DEPTH, HALF_WIDTH = 0.42, 0.58  # m; the front is at x = 0, as in RoboCAS-v0's numbers
POST = 0.04
BOARD = 0.022


def make_shelf() -> FurnitureSource:
    """Make a shelf that is open at the front, x = 0.

    The origin is on the floor at the middle of the front.
    """
    body = Body(
        {
            "oak": make_wood(OAK, (1.2, 0.45)),
            "steel": BLACK_STEEL,
            "back": WHITE,
            "rail": make_coating((222, 226, 228)),
        },
        seed=3,
        roughness=0.55,
    )
    y, back = HALF_WIDTH, -DEPTH
    for side in (-1, 1):
        for x in (0.0, back + POST):
            body.add_board((x - POST, side * y, 0), (x, side * (y - POST), TOP), "steel", bevel=0.003)
        for z in (*LAYERS, TOP):  # bars that carry the boards
            body.add_board((back + POST, side * y, z - 0.05), (-POST, side * (y - POST), z), "steel")
    inner = y - POST
    for z in (*LAYERS, TOP):
        body.add_board((back, -inner, z - BOARD), (0.0, inner, z), "oak", bevel=0.002)
        if z < TOP:
            body.add_board((-0.004, -inner, z - 0.05), (0.006, inner, z - 0.004), "rail", collide=False)
    body.add_board((back, -inner, LAYERS[0]), (back + 0.008, inner, TOP - BOARD), "back")
    ceilings = (*LAYERS[1:], TOP)
    surfaces = {
        f"layer_{i}": make_surface((back + 0.02, -0.53), (-0.01, 0.53), z, ceilings[i] - BOARD - z)
        for i, z in enumerate(LAYERS)
    }
    return FurnitureSource("shelf", "shelf", "shelf", body.make_mesh(), body.pieces, surfaces=surfaces)
