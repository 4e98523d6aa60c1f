"""Toys, tools and a few things of desk and sport: the table of those that are modelled freely in space."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial

import numpy as np
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation

from asset_tools.builtin import animals, planes, tools
from asset_tools.builtin.mesh import Patch, Shape, Size, fitted
from asset_tools.builtin.models import Model, paint_in_space, unwrapped
from asset_tools.builtin.spec import ObjectSpec
from asset_tools.builtin.surfaces import FACES
from asset_tools.builtin.textures import Colour, Painter
from asset_tools.decompose import few_vertices

STICKERS: dict[str, Colour] = {
    "top": (242, 242, 240),
    "bottom": (250, 214, 18),
    "front": (12, 150, 74),
    "back": (14, 78, 180),
    "right": (196, 24, 32),
    "left": (250, 122, 16),
}
TURNS = ((0, 1, 1), (1, -1, 1), (2, 1, 3), (0, -1, 3), (1, 1, 1), (2, -1, 1), (0, 1, 2), (1, 1, 3), (2, 1, 1))
CUBIE, BEVEL, SINK = 0.0190, 0.0014, 0.0011  # m


def rubiks_cube(size: Size) -> Shape:
    """A cube of 3 x 3 x 3 cubies with bevelled edges; one region a face."""
    half, groove = size[0] / 2, CUBIE / 2
    inner = half - BEVEL
    positive = [groove - BEVEL, groove, groove + BEVEL, inner, half]
    line = np.array([*(-v for v in reversed(positive)), *positive])
    is_groove = np.isclose(np.abs(line), groove)
    is_edge = np.isclose(np.abs(line), half)
    patches = []
    for name, ((right, right_sign), (up, up_sign)) in FACES.items():
        across = 3 - right - up
        outward = np.cross(np.eye(3)[right] * right_sign, np.eye(3)[up] * up_sign)[across]
        u, v = np.meshgrid(line, line)
        u_groove, v_groove = np.meshgrid(is_groove, is_groove)
        u_edge, v_edge = np.meshgrid(is_edge, is_edge)
        # A point sinks below every face it lies on: by grooves across that face, and by the bevel along its edges.
        points = np.zeros((*u.shape, 3))
        on_edge = u_edge.astype(int) + v_edge
        sink = np.where(u_groove | v_groove, SINK, 0.0)
        bevel = np.where(on_edge > 0, 0.45 * BEVEL, 0.0)
        depth = np.maximum(sink, bevel)
        points[..., across] = outward * (half - depth)
        points[..., right] = right_sign * np.where(u_edge, np.sign(u) * (half - depth), u)
        points[..., up] = up_sign * np.where(v_edge, np.sign(v) * (half - depth), v)
        uv = np.stack([u, v], axis=-1) / (2 * half) + 0.5
        patches.append(Patch(name, points, uv, (2 * half, 2 * half)))
    body = np.concatenate([patch.points.reshape(-1, 3) for patch in patches])
    return fitted([patches], size, pieces=[few_vertices(body)])


def paint_cube(shape: Shape, rng: np.random.Generator) -> Image.Image:
    """Coloured stickers with round corners on black, as some turns leave them."""
    painter = Painter(shape, rng, (16, 16, 18))
    for name, colours in scrambled().items():
        with painter.region(name) as canvas:
            for i, colour in enumerate(colours):
                left, top = (i % 3) / 3, (i // 3) / 3
                canvas.rectangle((left + 0.032, top + 0.032, left + 0.301, top + 0.301), colour, corner=0.16)
    return painter.image()


def scrambled(turns: tuple[tuple[int, int, int], ...] = TURNS) -> dict[str, list[Colour]]:
    """The nine stickers of each face, rows from the top as seen from outside.

    Args:
        turns: of a solved cube: (axis, layer -1 to 1, quarter turns).
    """
    slots = {}  # (place, normal) of a sticker -> (face, number)
    for name, ((right, right_sign), (up, up_sign)) in FACES.items():
        u, v = np.eye(3, dtype=int)[right] * right_sign, np.eye(3, dtype=int)[up] * up_sign
        normal = np.cross(u, v)
        for i in range(9):
            slots[tuple(np.concatenate([normal + u * (i % 3 - 1) + v * (1 - i // 3), normal]).tolist())] = name, i
    stickers = np.array(list(slots)).reshape(-1, 2, 3)
    for axis, layer, quarters in turns:
        moves = stickers[:, 0, axis] == layer
        turn = np.rint(Rotation.from_rotvec(np.eye(3)[axis] * quarters * np.pi / 2).as_matrix()).astype(int)
        stickers[moves] = stickers[moves] @ turn.T
    faces: dict[str, list[Colour]] = {name: [(0, 0, 0)] * 9 for name in FACES}
    for (home, _), sticker in zip(slots.values(), stickers.reshape(-1, 6).tolist(), strict=True):
        name, i = slots[tuple(sticker)]
        faces[name][i] = STICKERS[home]
    return faces


def ball(size: Size, *, texture_size: int = 256) -> Shape:
    """A sphere."""
    sphere = trimesh.creation.icosphere(subdivisions=3)
    points = sphere.vertices * np.asarray(size) / sphere.extents
    middle = (points.max(0) + points.min(0)) / 2
    return unwrapped(points - middle, np.asarray(sphere.faces), texture_size, (few_vertices(points - middle),))


def paint_racquetball(shape: Shape, rng: np.random.Generator) -> Image.Image:
    """Blue rubber with a moulded seam and a white print."""

    def colours(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        x, y, z = (1000 * points).T
        result = np.tile(np.array([24, 78, 190], float), (len(points), 1))
        # The seam of two halves; it lies level as on a ball that was just moulded.
        result *= (1 - 0.45 * np.exp(-((z / 0.45) ** 2)) + 0.22 * np.exp(-(((np.abs(z) - 1.2) / 0.5) ** 2)))[:, None]
        front = y < 0
        result[front & tools.lettering("PRO", x, z - 11.5, 7.0)] = (240, 244, 250)
        result[front & (np.abs(z - 5.6) < 0.6) & (np.abs(x) < 9)] = (240, 244, 250)
        return result

    return paint_in_space(shape, colours)


@cache
def _model(maker: Callable[[], Model]) -> Model:
    return maker()


def _shape(size: Size, *, maker: Callable[[], Model]) -> Shape:
    return _model(maker).shape(size)


def _paint(shape: Shape, rng: np.random.Generator, *, maker: Callable[[], Model]) -> Image.Image:
    return _model(maker).paint(shape, rng)


def _toy(
    id: str,
    category: str,
    size: Size,
    mass: float,
    maker: Callable[[], Model],
    graspnet_id: int,
    roughness: float,
    spoken: str = "",
    *,
    hollow: bool = False,
) -> ObjectSpec:
    shape, paint = partial(_shape, maker=maker), partial(_paint, maker=maker)
    return ObjectSpec(id, category, size, mass, shape, paint, roughness, graspnet_id, spoken, hollow)


TOYS: tuple[ObjectSpec, ...] = (
    _toy("power_drill", "tool", (0.184, 0.057, 0.187), 0.895, tools.power_drill, 8, 0.5),
    _toy("scissors", "tool", (0.200, 0.087, 0.016), 0.082, tools.scissors, 9, 0.35, hollow=True),
    _toy("flat_screwdriver", "tool", (0.215, 0.031, 0.031), 0.098, tools.screwdriver, 20, 0.35, "screwdriver"),
    ObjectSpec(
        "racquetball", "ball", (0.055, 0.055, 0.055), 0.041, ball, paint_racquetball, 0.7, 21, "blue rubber ball"
    ),
    _toy(
        "toy_airplane_a",
        "toy",
        (0.140, 0.150, 0.062),
        0.095,
        planes.red_airplane,
        24,
        0.5,
        "red toy airplane",
        hollow=True,
    ),
    _toy(
        "toy_airplane_c",
        "toy",
        (0.160, 0.142, 0.064),
        0.085,
        planes.airliner,
        25,
        0.35,
        "white toy airplane",
        hollow=True,
    ),
    _toy(
        "toy_airplane_k",
        "toy",
        (0.108, 0.120, 0.063),
        0.080,
        planes.biplane,
        31,
        0.45,
        "yellow toy biplane",
        hollow=True,
    ),
    _toy("padlock", "lock", (0.047, 0.027, 0.075), 0.304, tools.padlock, 32, 0.3),
    _toy("white_mouse", "mouse", (0.105, 0.060, 0.037), 0.090, tools.computer_mouse, 47, 0.4, "white computer mouse"),
    _toy("large_elephant", "toy", (0.150, 0.070, 0.095), 0.140, animals.large_elephant, 51, 0.6, "grey toy elephant"),
    _toy("rhinoceros", "toy", (0.135, 0.048, 0.068), 0.095, animals.rhinoceros, 52, 0.6, "toy rhinoceros"),
    _toy(
        "small_elephant",
        "toy",
        (0.090, 0.045, 0.060),
        0.050,
        animals.small_elephant,
        53,
        0.5,
        "small blue toy elephant",
    ),
    _toy("monkey", "toy", (0.055, 0.060, 0.080), 0.065, animals.monkey, 54, 0.55, "toy monkey"),
    ObjectSpec("rubiks_cube", "toy", (0.057, 0.057, 0.057), 0.094, rubiks_cube, paint_cube, 0.3, 71, "puzzle cube"),
)
