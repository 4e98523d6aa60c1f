"""Make a room of 6 x 6 x 4 m with several finishes of the walls and the floor."""

from __future__ import annotations

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from asset_tools.builtin.finishes import CEILING, FLOORS, TILE, WALLS
from asset_tools.builtin.furniture.base import make_box_corners, make_surface
from asset_tools.builtin.materials import Grid, Paint
from asset_tools.sources import FurnitureSource

HALF, HEIGHT = 3.0, 4.0
SLAB = 0.1  # m, thickness of floor and walls, outside of the room
PIXELS = 800
SKIRTING = (0.09, 0.014)  # m, height and thickness; without collision pieces

Quad = tuple[np.ndarray, np.ndarray, np.ndarray]  # lower left corner, vector to the right, vector upwards


def make_room(pixels: int = PIXELS) -> FurnitureSource:
    """Make a closed room around the origin of the world frame, without a door.

    Its faces are visible from inside.

    Args:
        pixels: width and height of the images of the finishes, for 2 x 2 m.
    """
    outer = HALF + SLAB
    pieces = [make_box_corners((-outer, -outer, -SLAB), (outer, outer, 0))]
    for x, y in ((1, 0), (0, 1), (-1, 0), (0, -1)):
        size = (SLAB, 2 * outer, HEIGHT) if x else (2 * outer, SLAB, HEIGHT)
        center = np.array([x * (HALF + SLAB / 2), y * (HALF + SLAB / 2), HEIGHT / 2])
        pieces.append(make_box_corners(center - np.divide(size, 2), center + np.divide(size, 2)))
    walls, floor = _walls(), _level(0.0)
    return FurnitureSource(
        "room",
        "room",
        "room",
        _fixed(),
        pieces,
        surfaces={"floor": make_surface((-HALF, -HALF), (HALF, HALF), 0.0)},
        finishes={
            "wall": {name: _tiled(walls, _picture(paint, pixels)) for name, paint in WALLS.items()},
            "floor": {name: _tiled(floor, _picture(paint, pixels)) for name, paint in FLOORS.items()},
        },
    )


def _walls() -> list[Quad]:
    quads = []
    for turn in range(4):  # the wall at +y, and its rotations about z
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
    """Return the mesh of the white ceiling and skirting boards, which all finishes have."""
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
    colours = paint(Grid.from_size((TILE, TILE), (pixels, pixels)), np.random.default_rng(11))
    return Image.fromarray(np.clip(colours, 0, 255).astype(np.uint8))


def _tiled(quads: list[Quad], image: Image.Image) -> trimesh.Trimesh:
    """Return a mesh of rectangles, each of which shows the whole image."""
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
