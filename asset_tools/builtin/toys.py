"""Make and paint a puzzle cube and a ball."""

from __future__ import annotations

import numpy as np
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation

from asset_tools.builtin.mesh import Patch, Shape, Size, build_fitted_shape
from asset_tools.builtin.models import make_uv_mapped_shape, paint_in_space
from asset_tools.builtin.surfaces import FACES
from asset_tools.builtin.textures import Colour, Painter, compute_text_mask
from asset_tools.decompose import reduce_hull_vertices

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


def make_rubiks_cube(size: Size) -> Shape:
    """Make a puzzle cube of 3 x 3 x 3 small cubes with bevelled edges; one region per face, as in `FACES`."""
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
        # a point is lower in the grooves of its face, and at bevelled edges
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
    return build_fitted_shape([patches], size, pieces=[reduce_hull_vertices(body)])


def paint_rubiks_cube(shape: Shape, rng: np.random.Generator) -> Image.Image:
    """Paint the stickers of a scrambled Rubik's Cube on a black background."""
    painter = Painter(shape, rng, (16, 16, 18))
    for name, colours in scramble_stickers().items():
        with painter.open_region(name) as canvas:
            for i, colour in enumerate(colours):
                left, top = (i % 3) / 3, (i // 3) / 3
                canvas.draw_rectangle((left + 0.032, top + 0.032, left + 0.301, top + 0.301), colour, corner=0.16)
    return painter.make_image()


def scramble_stickers(turns: tuple[tuple[int, int, int], ...] = TURNS) -> dict[str, list[Colour]]:
    """Return name of a face -> colours of its nine stickers, row by row from the top, seen from outside.

    Args:
        turns: turns that scramble a solved cube: axis (0 to 2), layer (-1 to 1), number of quarter turns.
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


def make_ball(size: Size, *, texture_size: int = 256) -> Shape:
    """Make a ball without regions; its texture is painted with `paint_in_space`."""
    sphere = trimesh.creation.icosphere(subdivisions=3)
    points = sphere.vertices * np.asarray(size) / sphere.extents
    middle = (points.max(0) + points.min(0)) / 2
    return make_uv_mapped_shape(
        points - middle, np.asarray(sphere.faces), texture_size, (reduce_hull_vertices(points - middle),)
    )


def paint_racquetball(shape: Shape, rng: np.random.Generator) -> Image.Image:
    """Paint a racquetball: blue rubber with the seam of the mould and a white print."""

    def colours(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        x, y, z = (1000 * points).T
        result = np.tile(np.array([24, 78, 190], float), (len(points), 1))
        # the horizontal seam between the two halves
        result *= (1 - 0.45 * np.exp(-((z / 0.45) ** 2)) + 0.22 * np.exp(-(((np.abs(z) - 1.2) / 0.5) ** 2)))[:, None]
        front = y < 0
        result[front & compute_text_mask("PRO", x, z - 11.5, 7.0)] = (240, 244, 250)
        result[front & (np.abs(z - 5.6) < 0.6) & (np.abs(x) < 9)] = (240, 244, 250)
        return result

    return paint_in_space(shape, colours)
