"""Make a sideboard with two drawers above two doors, and a cupboard with a sliding door."""

from __future__ import annotations

from typing import Literal

import numpy as np

from asset_tools.builtin.furniture.base import BAR, BAR_GAP, Body, make_bar_grasp, make_hinge, make_slide, make_surface
from asset_tools.builtin.materials import BEECH, DARK, OAK, STEEL, make_coating, make_wood
from asset_tools.sources import FurnitureSource, LinkSource

BOARD = 0.02  # m, thickness of boards
GAP = 0.004  # m, between fronts, and around a drawer
SIDES: dict[str, Literal[-1, 1]] = {"left": -1, "right": 1}  # for a person who faces the furniture

SAGE = make_coating((142, 160, 144))
CREAM = make_coating((232, 226, 212))
PALE = make_wood(BEECH, (0.6, 0.42))


def make_cabinet() -> FurnitureSource:
    """Make a cabinet with two drawers above two doors.

    The origin is on the floor below the centre of the body.
    """
    back, front, half, height = -0.25, 0.22, 0.60, 0.92
    plinth, floor, middle = 0.08, 0.10, 0.65
    body = Body({"oak": make_wood(OAK, (1.25, 0.5)), "dark": DARK, "inside": PALE}, seed=4, roughness=0.55)
    for side in (-1, 1):
        body.add_board((back, side * half, plinth), (front, side * (half - BOARD), height - BOARD), "oak", grain=2)
    body.add_board((back, -half, height - BOARD), (front + 0.028, half, height), "oak", bevel=0.002)
    inner = half - BOARD
    for z in (floor, middle):
        body.add_board((back, -inner, z - BOARD), (front, inner, z), "inside")
    body.add_board((back, -BOARD / 2, floor), (front, BOARD / 2, height - BOARD), "inside", grain=2)
    body.add_board((back, -inner, floor), (back + 0.008, inner, height - BOARD), "inside")
    body.add_board((back + 0.02, -half + 0.03, 0), (front - 0.05, half - 0.03, plinth), "dark")

    face = front + 0.003
    bar_x = face + BOARD + BAR_GAP + BAR / 2
    links, handles = [], {}
    surfaces = {"top": make_surface((back, -half), (front, half), height)}
    for name, side in SIDES.items():
        low, high = sorted((side * GAP / 2, side * half))
        door = f"door_{name}"
        grip = (bar_x, side * 0.06, 0.50)
        links.append(_door(door, face, (low, high), (plinth + 0.004, middle - BOARD / 2 - GAP / 2), side, grip))
        handles[door] = make_bar_grasp(door, grip, along="z")
        drawer = f"drawer_{name}"
        center = (low + high) / 2
        grip = (bar_x, round(center, 6), 0.775)
        bay = sorted((side * BOARD / 2, side * inner))
        links.append(_drawer(drawer, (back, face), (low, high), bay, (middle, height - BOARD), grip))
        handles[drawer] = make_bar_grasp(drawer, grip, along="y")
        surfaces[f"compartment_{name}"] = make_surface(
            (back + 0.01, bay[0]), (front, bay[1]), floor, middle - BOARD - floor
        )
        bottom = middle + 0.02
        surfaces[drawer] = make_surface(
            (back + 0.04, bay[0] + 0.025), (face - 0.015, bay[1] - 0.025), bottom, height - BOARD - bottom, drawer
        )
    return FurnitureSource(
        "cabinet",
        "cabinet",
        "cabinet",
        body.make_mesh(),
        body.pieces,
        surfaces=surfaces,
        links=tuple(links),
        handles=handles,
    )


def _door(
    name: str,
    face: float,
    y: tuple[float, float],
    z: tuple[float, float],
    side: Literal[-1, 1],
    grip: tuple[float, float, float],
) -> LinkSource:
    """Make a door with a frame and a hinge at its outer edge.

    Args:
        name: name of the link.
        face: x of the back of the door, m.
        y: left and right edge, m.
        z: lower and upper edge, m.
        side: -1 for the left door, 1 for the right door.
        grip: centre of the handle, m.
    """
    body = Body({"paint": SAGE, "steel": STEEL}, seed=5, texture=256, roughness=0.5)
    _framed_front(body, face, y, z)
    body.add_bar_handle(np.array(grip), 0.18, "steel", along="z")
    outer = y[0] if side < 0 else y[1]
    return LinkSource(name, make_hinge(f"{name}_hinge", (face, outer, 0.0), side), body.make_mesh(), body.pieces, 6.0)


def _drawer(
    name: str,
    x: tuple[float, float],
    y: tuple[float, float],
    bay: list[float],
    z: tuple[float, float],
    grip: tuple[float, float, float],
) -> LinkSource:
    """Make a drawer.

    Args:
        name: name of the link.
        x: back of the cabinet, and back of the front of the drawer, m.
        y: left and right edge of the front, m.
        bay: left and right side of the space for the drawer, m.
        z: bottom and top of this space, m.
        grip: centre of the handle, m.
    """
    body = Body({"paint": SAGE, "steel": STEEL, "inside": PALE}, seed=6, texture=512, roughness=0.5)
    (back, face), board = (x[0] + 0.02, x[1]), 0.012
    low, high = bay[0] + 0.010, bay[1] - 0.010
    bottom, top = z[0] + 0.02, z[1] - 0.07
    _framed_front(body, face, y, (z[0] - BOARD / 2 + GAP / 2, z[1] - GAP), frame=0.035)
    body.add_board((back, low, bottom - board), (face, high, bottom), "inside")
    for a, b in ((low, low + board), (high - board, high)):
        body.add_board((back, a, bottom), (face, b, top), "inside")
    body.add_board((back, low + board, bottom), (back + board, high - board, top), "inside")
    body.add_board((face - board, low + board, bottom), (face, high - board, top), "inside")
    for a, b in ((bay[0] + 0.002, low), (high, bay[1] - 0.002)):  # runners
        body.add_board((back, a, bottom + 0.03), (face - 0.02, b, bottom + 0.06), "steel", collide=False)
    body.add_bar_handle(np.array(grip), 0.20, "steel", along="y")
    return LinkSource(name, make_slide(f"{name}_slide", (1.0, 0.0, 0.0), 0.36), body.make_mesh(), body.pieces, 4.0)


def _framed_front(
    body: Body, face: float, y: tuple[float, float], z: tuple[float, float], *, frame: float = 0.07
) -> None:
    """Add a front with a recessed panel in a frame; its collision piece is one board.

    Args:
        body: body of the door or drawer.
        face: x of the back of the front, m.
        y: left and right edge, m.
        z: lower and upper edge, m.
        frame: width of the frame, m.
    """
    out = face + BOARD
    body.pieces.append(_corners((face, y[0], z[0]), (out, y[1], z[1])))
    body.add_board((face, y[0], z[0]), (out - 0.007, y[1], z[1]), "paint", collide=False)
    for low, high in ((z[0], z[0] + frame), (z[1] - frame, z[1])):
        body.add_board((out - 0.008, y[0] + frame, low), (out, y[1] - frame, high), "paint", bevel=0.002, collide=False)
    for low, high in ((y[0], y[0] + frame), (y[1] - frame, y[1])):
        body.add_board((out - 0.008, low, z[0]), (out, high, z[1]), "paint", bevel=0.002, collide=False)


def _corners(low: tuple[float, float, float], high: tuple[float, float, float]) -> np.ndarray:
    return np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T


def make_container() -> FurnitureSource:
    """Make a cupboard with two layers behind a door that slides to the left.

    The origin is on the floor; x and y are as in RoboCAS-v0.
    """
    back, front, low, high, height = -0.30, 0.335, -0.80, 0.74, 1.13
    board, layers = 0.024, (0.055, 0.60)
    divider = 0.13  # y; the layers are on the right, a closed space is on the left
    body = Body({"wood": make_wood(BEECH, (1.55, 0.66)), "cream": CREAM, "dark": DARK}, seed=7, roughness=0.55)
    inner = (low + board, high - board)
    for y in (low, high - board):
        body.add_board((back, y, 0), (front, y + board, height - board), "wood", grain=2)
    body.add_board((back, low, height - board), (front, high, height), "wood", bevel=0.002)
    body.add_board((back, inner[0], layers[0] - board), (front, inner[1], layers[0]), "wood")
    body.add_board((back, divider - board, layers[0]), (0.28, divider, height - board), "wood", grain=2)
    body.add_board((back, divider, layers[1] - board), (0.28, inner[1], layers[1]), "wood")
    body.add_board((back, inner[0], layers[0]), (back + 0.01, inner[1], height - board), "wood")
    body.add_board((0.283, inner[0], layers[0]), (0.303, divider, height - board), "cream", grain=2)
    body.add_board((0.25, inner[0], 0), (0.265, inner[1], layers[0] - board), "dark")

    door = Body({"wood": make_wood(BEECH, (1.1, 0.62)), "steel": STEEL}, seed=8, texture=512, roughness=0.55)
    x, clear = 0.309, 0.004
    y = (divider - 0.03, inner[1] - clear)
    z = (layers[0] + clear, height - board - clear)
    door.add_board((x, y[0], z[0]), (x + 0.021, y[1], z[1]), "wood", bevel=0.002, grain=2)
    grip = (0.378, 0.672, 0.557)  # as in RoboCAS-v0, whose origin is 0.557 m above the floor
    door.add_bar_handle(np.array(grip), 0.30, "steel", along="z")
    joint = make_slide("door_slide", (0.0, -1.0, 0.0), 0.55)
    ceilings = (layers[1] - board, height - board)
    surfaces = {
        f"layer_{i}": make_surface((back + 0.015, divider + 0.035), (0.275, inner[1] - 0.006), z, ceilings[i] - z)
        for i, z in enumerate(layers)
    }
    surfaces["top"] = make_surface((back, low), (front, high), height)
    return FurnitureSource(
        "container",
        "container",
        "container",
        body.make_mesh(),
        body.pieces,
        surfaces=surfaces,
        links=(LinkSource("door", joint, door.make_mesh(), door.pieces, 8.0),),
        handles={"door": make_bar_grasp("door", grip, along="z")},
    )
