"""A room of 6 x 6 x 4 m, whose walls and floor come in several finishes."""

from __future__ import annotations

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from asset_tools.builtin.finishes import CEILING, FLOORS, TILE, WALLS
from asset_tools.builtin.furniture.base import block, surface
from asset_tools.builtin.materials import Grid, Paint
from asset_tools.sources import FurnitureSource

HALF, HEIGHT = 3.0, 4.0
SLAB = 0.1  # m, thickness of floor and walls, outside of the room
PIXELS = 800
SKIRTING = (0.09, 0.014)  # m, height and thickness; only for the eye

Quad = tuple[np.ndarray, np.ndarray, np.ndarray]  # a lower left corner, the way right, the way up


def room(pixels: int = PIXELS) -> FurnitureSource:
    """A closed room around the world's origin, seen from inside; it has no door.

    Args:
        pixels: width of the images of its walls and floors.
    """
    outer = HALF + SLAB
    pieces = [block((-outer, -outer, -SLAB), (outer, outer, 0))]
    for x, y in ((1, 0), (0, 1), (-1, 0), (0, -1)):
        size = (SLAB, 2 * outer, HEIGHT) if x else (2 * outer, SLAB, HEIGHT)
        center = np.array([x * (HALF + SLAB / 2), y * (HALF + SLAB / 2), HEIGHT / 2])
        pieces.append(block(center - np.divide(size, 2), center + np.divide(size, 2)))
    walls, floor = _walls(), _level(0.0)
    return FurnitureSource(
        "room",
        "room",
        "room",
        _fixed(),
        pieces,
        surfaces={"floor": surface((-HALF, -HALF), (HALF, HALF), 0.0)},
        finishes={
            "wall": {name: _tiled(walls, _picture(paint, pixels)) for name, paint in WALLS.items()},
            "floor": {name: _tiled(floor, _picture(paint, pixels)) for name, paint in FLOORS.items()},
        },
    )


def _walls() -> list[Quad]:
    quads = []
    for turn in range(4):  # the wall at +y, and its turns about z
        right = np.array([(1, 0, 0), (0, 1, 0), (-1, 0, 0), (0, -1, 0)][turn], float)
        back = np.array([-right[1], right[0], 0.0])
        for across in np.arange(-HALF, HALF, TILE):
            for z in np.arange(0, HEIGHT, TILE):
                corner = back * HALF + right * across + np.array([0, 0, z])
                quads.append((corner, right * TILE, np.array([0, 0, TILE])))
    return quads


def _level(z: float, *, upward: bool = True) -> list[Quad]:
    way = [np.array([TILE, 0, 0]), np.array([0, TILE, 0])]
    right, up = way if upward else way[::-1]
    steps = np.arange(-HALF, HALF, TILE)
    return [(np.array([x, y, z]), right, up) for x in steps for y in steps]


def _fixed() -> trimesh.Trimesh:
    """Ceiling and skirting boards: white, the same with every finish."""
    quads = _level(HEIGHT, upward=False)
    high, thick = SKIRTING
    inner = HALF - thick
    for turn in range(4):
        right = np.array([(1, 0, 0), (0, 1, 0), (-1, 0, 0), (0, -1, 0)][turn], float)
        back = np.array([-right[1], right[0], 0.0])
        for across in np.arange(-HALF, HALF, TILE):
            face = back * inner + right * across
            quads.append((face, right * TILE, np.array([0, 0, high])))
            quads.append((face + (0, 0, high), right * TILE, back * thick))
    return _tiled(quads, _picture(CEILING, 256))


def _picture(paint: Paint, pixels: int) -> Image.Image:
    colours = paint(Grid.of((TILE, TILE), (pixels, pixels)), np.random.default_rng(11))
    return Image.fromarray(np.clip(colours, 0, 255).astype(np.uint8))


def _tiled(quads: list[Quad], image: Image.Image) -> trimesh.Trimesh:
    """Each quad shows the whole image."""
    points = np.concatenate([[corner, corner + right, corner + right + up, corner + up] for corner, right, up in quads])
    normals = np.concatenate([[np.cross(right, up)] * 4 for _, right, up in quads])
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    first = 4 * np.arange(len(quads))[:, None, None]
    faces = (first + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
    uv = np.tile([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)], (len(quads), 1))
    material = PBRMaterial(
        baseColorTexture=image, baseColorFactor=[255, 255, 255, 255], metallicFactor=0.0, roughnessFactor=0.8
    )
    return trimesh.Trimesh(
        points,
        faces,
        vertex_normals=normals,
        visual=TextureVisuals(uv=uv, material=material),
        process=False,
        validate=False,
    )
