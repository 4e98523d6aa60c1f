"""Make a white refrigerator above a freezer, each with a door."""

from __future__ import annotations

import numpy as np

from asset_tools.builtin.furniture.base import BAR_GAP, Body, make_bar_grasp, make_hinge, make_surface
from asset_tools.builtin.materials import DARK, STEEL, make_coating
from asset_tools.sources import FurnitureSource, LinkSource

BACK, FRONT, HALF, HEIGHT = -0.36, 0.30, 0.35, 1.75
WALL = 0.045
DOOR, DOOR_GAP = 0.055, 0.004
BAR = 0.014
FREEZER = (0.10, 0.60)  # m, heights of the doors
FRIDGE = (0.606, 1.745)
FLOORS = {"freezer": (0.145, 0.58), "shelf_0": (0.66, 0.968), "shelf_1": (0.98, 1.298), "shelf_2": (1.31, 1.70)}

ENAMEL = make_coating((238, 240, 240))
LINER = make_coating((246, 247, 247))
GLASS = make_coating((196, 218, 216))


def make_refrigerator() -> FurnitureSource:
    """Make a refrigerator with two doors with hinges at the left edge.

    The origin is on the floor below the centre.
    """
    body = Body({"enamel": ENAMEL, "liner": LINER, "glass": GLASS, "dark": DARK}, seed=9, texture=256, roughness=0.35)
    inner = HALF - WALL
    bottom = 0.10
    for side in (-1, 1):  # the liner is visible from inside, the enamel from outside
        body.add_board(
            (BACK, side * HALF, bottom), (FRONT, side * (inner + 0.01), HEIGHT), "enamel", bevel=0.003, collide=False
        )
        body.add_board(
            (BACK + 0.02, side * (HALF - 0.02), bottom + 0.01),
            (FRONT - 0.001, side * inner, HEIGHT - 0.02),
            "liner",
            collide=False,
        )
        body.pieces.append(
            np.array(np.meshgrid((BACK, FRONT), (side * HALF, side * inner), (bottom, HEIGHT))).reshape(3, -1).T
        )
    body.add_board((BACK, -inner, bottom), (BACK + 0.05, inner, HEIGHT), "liner")
    body.add_board(
        (BACK - 0.002, -HALF + 0.01, bottom + 0.01), (BACK, HALF - 0.01, HEIGHT - 0.01), "enamel", collide=False
    )
    body.add_board((BACK, -inner, bottom), (FRONT, inner, 0.145), "liner")
    body.add_board((BACK, -inner, 0.58), (FRONT, inner, 0.66), "liner")
    body.add_board((BACK, -inner, 1.70), (FRONT, inner, HEIGHT - 0.008), "liner")
    body.add_board((BACK, -HALF, HEIGHT - 0.01), (FRONT, HALF, HEIGHT), "enamel", bevel=0.003)
    for z in (0.98, 1.31):
        body.add_board((BACK + 0.05, -inner, z - 0.012), (0.18, inner, z), "glass")
        body.add_board((0.18, -inner, z - 0.014), (0.19, inner, z + 0.002), "liner", collide=False)
    body.add_board((BACK + 0.05, -HALF + 0.03, 0), (FRONT - 0.03, HALF - 0.03, bottom), "dark")

    links, handles = [], {}
    for name, (low, high), bar, mass in (
        ("freezer_door", FREEZER, (0.34, 0.56), 5.0),
        ("door", FRIDGE, (0.70, 1.12), 9.0),
    ):
        link, grip = _door(name, low, high, bar, mass, bins=(0.72, 1.05, 1.38) if name == "door" else ())
        links.append(link)
        handles[name] = make_bar_grasp(name, grip, along="z", bar=BAR)
    room = 0.175  # m, x up to which the racks of the door leave space
    surfaces = {
        name: make_surface(
            (BACK + 0.055, -inner + 0.003), (room if name != "freezer" else FRONT - 0.01, inner - 0.003), z, top - z
        )
        for name, (z, top) in FLOORS.items()
    }
    surfaces["top"] = make_surface((BACK, -HALF), (FRONT, HALF), HEIGHT)
    return FurnitureSource(
        "refrigerator",
        "refrigerator",
        "refrigerator",
        body.make_mesh(),
        body.pieces,
        surfaces=surfaces,
        links=tuple(links),
        handles=handles,
    )


def _door(
    name: str, low: float, high: float, bar: tuple[float, float], mass: float, *, bins: tuple[float, ...]
) -> tuple[LinkSource, tuple[float, float, float]]:
    """Make a door; return its link and the centre of its handle.

    Args:
        name: name of the link.
        low: z of the lower edge, m.
        high: z of the upper edge, m.
        bar: z of the lower and upper end of the handle, m.
        mass: mass of the door, kg.
        bins: z of the racks on the inside, m.
    """
    body = Body(
        {"enamel": ENAMEL, "liner": LINER, "steel": STEEL, "glass": GLASS, "dark": DARK},
        seed=10,
        texture=256,
        roughness=0.35,
    )
    face = FRONT + DOOR_GAP
    out = face + DOOR
    body.add_board((face, -HALF, low), (out, HALF, high), "enamel", bevel=0.006)
    body.add_board(
        (face - 0.003, -HALF + 0.02, low + 0.02), (face + 0.001, HALF - 0.02, high - 0.02), "dark", collide=False
    )  # seal
    body.add_board(
        (face - 0.004, -HALF + 0.035, low + 0.035), (face + 0.001, HALF - 0.035, high - 0.035), "liner", collide=False
    )
    for z in bins:
        y = HALF - 0.10
        body.add_board((face - 0.10, -y, z), (face, y, z + 0.008), "liner")
        body.add_board((face - 0.10, -y, z + 0.008), (face - 0.094, y, z + 0.07), "glass")
        for side in (-1, 1):
            body.add_board((face - 0.10, side * y, z), (face, side * (y - 0.006), z + 0.07), "liner")
    if bins:  # temperature display
        body.add_board((out - 0.001, -0.06, high - 0.20), (out + 0.001, 0.06, high - 0.16), "dark", collide=False)
    grip = (out + BAR_GAP + BAR / 2, HALF - 0.055, round(sum(bar) / 2, 6))
    body.add_bar_handle(np.array(grip), bar[1] - bar[0], "steel", along="z", bar=BAR)
    joint = make_hinge(f"{name}_hinge", (face, -HALF, 0.0), -1)
    return LinkSource(name, joint, body.make_mesh(), body.pieces, mass), grip
