"""Make models of plastic toy animals; lengths in mm, heads towards +x, feet at z = 0."""

from __future__ import annotations

import numpy as np

from asset_tools.builtin.blends import chain, curve, ellipsoid, mirror_y, polygon
from asset_tools.builtin.models import Model, Part, make_box_pair
from asset_tools.builtin.textures import Colour

BLACK, WHITE, IVORY = (22, 20, 20), (245, 245, 242), (238, 228, 200)


def _dots(points: np.ndarray, colours: np.ndarray, colour: Colour, *spots: tuple[float, float, float, float]) -> None:
    """Paint the points (n, 3) inside balls (x, |y|, z, radius) with one colour.

    ``colours`` (n, 3) is changed.
    """
    folded = points * np.array([1, 0, 1], np.float32) + np.abs(points) * np.array([0, 1, 0], np.float32)
    for *center, radius in spots:
        colours[((folded - np.array(center, np.float32)) ** 2).sum(1) < radius**2] = colour


def _toenails(points: np.ndarray, colours: np.ndarray, colour: Colour, legs, radius: float, height: float) -> None:
    """Paint three toenails at the front of each foot; ``colours`` (n, 3) is changed.

    Args:
        points: (n, 3) points on the surface, mm.
        colours: (n, 3) colours of the points.
        colour: colour of the nails.
        legs: x and |y| of the legs, mm.
        radius: radius of a leg, mm.
        height: height of the nails, mm.
    """
    for x, y in legs:
        dx, dy = points[:, 0] - x, np.abs(points[:, 1]) - y
        angle = np.arctan2(dy, dx)
        level = points[:, 2] / height
        for middle in np.deg2rad([-52, 0, 52]):
            nail = ((angle - middle) / 0.36) ** 2 + np.maximum(level - 0.35, 0) ** 2 / 0.42 < 1
            colours[nail & (np.hypot(dx, dy) < 1.5 * radius) & (points[:, 2] < height)] = colour


def _wrinkles(points: np.ndarray, colours: np.ndarray, along: np.ndarray, pitch: float, depth: float) -> None:
    """Darken points along wrinkles; ``colours`` (n, 3) is changed.

    Args:
        points: (n, 3) points on the surface, mm.
        colours: (n, 3) colours of the points.
        along: (n,) position across the wrinkles, mm; NaN: no wrinkles.
        pitch: distance of the wrinkles, mm.
        depth: fraction by which the wrinkles are darker.
    """
    wave = np.cos(2 * np.pi * along / pitch)
    colours *= np.where(np.isfinite(along), 1 - depth * np.clip(wave - 0.4, 0, 1) / 0.6, 1)[:, None]


def make_large_elephant() -> Model:
    """Make a large grey elephant with large ears, tusks and a hanging trunk."""
    grey: Colour = (134, 134, 140)
    legs = ((26.0, 15.0), (-40.0, 15.0))
    ears = mirror_y(ellipsoid((34, 26, 68), (19, 3.6, 26), (8, 0, -32)))

    def decorate(points, normals, colours, rng):
        x, y, z = points.T
        _wrinkles(points, colours, np.where((x > 66) & (z < 64) & (np.abs(y) < 8.8), z - 0.3 * x, np.nan), 5.0, 0.22)
        inside = ((x - 33) / 13) ** 2 + ((z - 68) / 18) ** 2 < 1
        colours[inside & (normals[:, 0] > 0.2) & (ears(points) < 0.6)] = (186, 150, 150)
        _toenails(points, colours, (222, 214, 200), legs, 12, 8)
        _dots(points, colours, WHITE, (68.2, 15.0, 81.0, 1.2))
        mouth = (np.abs(z - 49 - 0.15 * (x - 60)) < 1.0) & (x > 54) & (x < 64) & (np.abs(y) > 6)
        colours[mouth] = (84, 80, 84)

    return Model(
        parts=(
            Part(ellipsoid((-12, 0, 60), (46, 27, 29)), grey),
            Part(ellipsoid((-36, 0, 61), (27, 26, 28)), grey, 12),
            Part(ellipsoid((20, 0, 63), (24, 24, 28)), grey, 12),
            Part(ellipsoid((50, 0, 74), (21, 17.5, 21)), grey, 9),
            Part(mirror_y(ellipsoid((52, 6, 88), (11, 8, 8))), grey, 6),
            Part(
                curve((64, 0, 70, 13), (74, 0, 54, 9.5), (77, 0, 36, 7.5), (77, 0, 19, 6.2), (84, 0, 9, 5.2)), grey, 8
            ),
            Part(mirror_y(chain((26, 15, 48, 12), (27, 15, 0, 11.5))), grey, 8),
            Part(mirror_y(chain((-40, 14, 50, 14), (-40, 15, 0, 11.5))), grey, 8),
            Part(ears, grey, 4),
            Part(curve((-60, 0, 70, 3.4), (-66, 0, 58, 2.8), (-68, 0, 42, 2.4)), grey, 5),
            Part(ellipsoid((-68, 0, 37), (3.4, 3.2, 7)), (62, 60, 64), 1),
            Part(mirror_y(curve((64, 10, 56, 4), (72, 13, 46, 3.2), (82, 13, 43, 2.6), (90, 11, 47, 1.6))), IVORY),
            Part(mirror_y(ellipsoid((65.5, 13.6, 79), (3.2, 2.8, 3.2))), BLACK),
        ),
        hulls=(
            ((-64, -40, 31), (2, 40, 104)),
            ((2, -24, 31), (20, 24, 104)),
            ((20, -22, 31), (35, 22, 104)),
            ((34, -20, 62), (90, 20, 104)),
            ((34, -14, 46), (62, 14, 62)),
            *make_box_pair((12, 2, -4), (44, 34, 33)),
            *make_box_pair((-60, 2, -4), (-22, 34, 33)),
            *make_box_pair((14, 23.5, 38), (34, 48, 104)),
            *make_box_pair((32, 20, 38), (56, 48, 104)),
            ((60, -9, 36), (92, 9, 62)),
            *make_box_pair((60, 8, 36), (100, 20, 62)),
            ((62, -12, -4), (100, 12, 36)),
            ((-80, -8, 28), (-64, 8, 76)),
        ),
        low=(-80, -48, -4),
        high=(100, 48, 104),
        decorate=decorate,
        floor=0.0,
        triangles=1850,
        texture_size=400,
    )


def make_small_elephant() -> Model:
    """Make a small, light blue elephant with a large head, pink insides of the ears and a raised trunk."""
    blue: Colour = (142, 186, 216)
    legs = ((16.0, 10.5), (-19.0, 10.5))
    ears = mirror_y(ellipsoid((16, 17, 42), (13, 2.8, 14), (10, 0, -42)))

    def decorate(points, normals, colours, rng):
        x, y, z = points.T
        inside = ((x - 14.5) / 8.5) ** 2 + ((z - 42) / 10) ** 2 < 1
        colours[inside & (normals[:, 0] > 0.05) & (ears(points) < 1.0)] = (240, 168, 186)
        _toenails(points, colours, WHITE, legs, 8.5, 5.5)
        _dots(points, colours, WHITE, (37.6, 9.9, 47.2, 1.1))
        cheek = np.hypot(x - 34, z - 36.5) < 2.6
        colours[cheek & (np.abs(y) > 7) & (ears(points) > 2)] = (226, 164, 186)
        smile = np.abs(np.hypot(x - 35, z - 38) - 9) < 0.6
        colours[smile & (z < 31.5) & (x > 31) & (np.abs(y) < 12)] = (70, 92, 116)

    return Model(
        parts=(
            Part(ellipsoid((-6, 0, 29), (26, 18, 19)), blue),
            Part(ellipsoid((25, 0, 42), (17, 15, 16.5)), blue, 6),
            Part(
                curve((36, 0, 38, 8), (45, 0, 33, 5.6), (52, 0, 36, 4.4), (54, 0, 46, 3.8), (51, 0, 54, 4.2)), blue, 5
            ),
            Part(mirror_y(chain((15, 10.5, 24, 8.5), (16, 10.5, 0, 8.2))), blue, 5),
            Part(mirror_y(chain((-19, 10.5, 26, 9.5), (-19, 10.5, 0, 8.2))), blue, 5),
            Part(ears, blue, 2),
            Part(curve((-30, 0, 34, 2.2), (-35, 0, 29, 1.9), (-36, 0, 23, 2.4)), blue, 3),
            Part(mirror_y(ellipsoid((36.5, 9.3, 45.5), (2.5, 2.2, 3.2))), BLACK),
        ),
        hulls=(
            ((-33, -20, 15), (6, 20, 60)),
            ((-20, -5, 8), (20, 5, 16)),
            ((6, -17, 14), (26, 17, 27)),
            ((6, -13.5, 27), (30, 13.5, 66)),
            ((24, -16, 24), (42, 16, 66)),
            *make_box_pair((6, 1, -4), (30, 26, 15)),
            *make_box_pair((-32, 1, -4), (-8, 26, 16)),
            *make_box_pair((3, 17, 26), (14, 34, 66)),
            *make_box_pair((14, 13, 26), (28, 24, 66)),
            ((41, -12, 24), (64, 12, 39)),
            ((46, -12, 38), (64, 12, 66)),
            ((-46, -6, 16), (-32, 6, 40)),
        ),
        low=(-46, -34, -4),
        high=(64, 34, 66),
        decorate=decorate,
        floor=0.0,
        step=0.7,
        triangles=1900,
        texture_size=384,
    )


def make_rhinoceros() -> Model:
    """Make a dark grey rhinoceros with folds of skin and a long, low head with two horns."""
    slate: Colour = (112, 104, 98)
    legs = ((28.0, 12.0), (-38.0, 12.0))

    def decorate(points, normals, colours, rng):
        x, y, z = points.T
        for middle, lean in ((14.0, 0.15), (-24.0, -0.2)):  # the folds between the plates
            fold = np.abs(x - middle - lean * (z - 40) - 2 * np.sin(z / 7))
            colours[(fold < 1.1) & (z > 20)] = (62, 56, 54)
        scales = np.cos(1.1 * x + 0.5 * y) + np.cos(1.1 * z - 0.5 * x) + np.cos(1.1 * y + 0.6 * z)
        colours *= (1 + 0.05 * np.where(x < 36, scales, 0))[:, None]
        _toenails(points, colours, (200, 190, 172), legs, 10, 6.5)
        _dots(points, colours, WHITE, (54.2, 9.7, 38.2, 0.9))
        _dots(points, colours, (48, 40, 40), (76, 5.4, 25, 1.5))
        mouth = np.abs(z - 18.5 - 0.1 * (x - 66)) < 0.7
        colours[mouth & (x > 62)] = (56, 46, 46)

    return Model(
        parts=(
            Part(ellipsoid((-8, 0, 40), (46, 22.5, 22)), slate),
            Part(ellipsoid((-32, 0, 40), (25, 22, 22)), slate, 8),
            Part(ellipsoid((24, 0, 45), (19, 20, 21)), slate, 8),
            Part(curve((32, 0, 42, 16), (50, 0, 34, 12.5), (66, 0, 25, 10)), slate, 8),
            Part(ellipsoid((71, 0, 23), (10, 9.5, 8.5)), slate, 5),
            Part(mirror_y(chain((26, 12, 30, 10.5), (28, 12, 0, 9.8))), slate, 6),
            Part(mirror_y(chain((-37, 12, 32, 12), (-38, 12, 0, 9.8))), slate, 6),
            Part(mirror_y(curve((40, 9, 50, 4), (38.5, 12, 58, 4), (38.5, 13.5, 64, 1.5))), slate, 3),
            Part(curve((73, 0, 29, 6.5), (78, 0, 40, 4.2), (78.5, 0, 55, 1.3)), (222, 208, 178), 2),
            Part(curve((62, 0, 35, 5), (65, 0, 42, 3.4), (65, 0, 49, 1.4)), (222, 208, 178), 2),
            Part(curve((-55, 0, 48, 2.4), (-59, 0, 38, 2), (-59, 0, 26, 2.6)), slate, 3),
            Part(mirror_y(ellipsoid((53.5, 9.6, 36.5), (2.3, 2.2, 2.3))), BLACK),
        ),
        hulls=(
            ((-57, -34, 19), (-4, 34, 80)),
            ((-4, -34, 19), (36, 34, 80)),
            ((36, -18, 10), (60, 18, 54)),
            ((60, -16, 10), (94, 16, 36)),
            ((66, -8, 36), (94, 8, 80)),
            ((54, -8, 35), (70, 8, 60)),
            *make_box_pair((14, 1, -4), (44, 30, 20)),
            *make_box_pair((-54, 1, -4), (-24, 30, 20)),
            *make_box_pair((32, 6, 52), (48, 24, 80)),
            ((-72, -8, 20), (-57, 8, 54)),
        ),
        low=(-72, -34, -4),
        high=(94, 34, 80),
        decorate=decorate,
        floor=0.0,
        step=0.9,
        triangles=1850,
        texture_size=400,
    )


def make_monkey() -> Model:
    """Make a brown, sitting monkey with round ears, a light face, arms on the knees and a curled tail."""
    brown: Colour = (120, 74, 44)
    tan: Colour = (232, 190, 146)
    face = polygon([(float(y), float(z)) for y, z in _heart(0, 60.5, 13.0, 12.5)])

    def decorate(points, normals, colours, rng):
        x, y, z = points.T
        colours[(x > 8) & (z > 46) & (np.abs(y) < 15) & (face(points[:, 1:]) < 0)] = tan
        belly = (y / 10.5) ** 2 + ((z - 27) / 13.5) ** 2 < 1
        colours[belly & (x > 9) & (normals[:, 0] > 0.3)] = tan
        inner_ear = np.hypot(np.abs(y) - 24.3, z - 63) < 4.2
        colours[inner_ear & (normals[:, 0] > 0.3)] = tan
        _dots(points, colours, BLACK, (19.3, 5.8, 65, 2.5))
        _dots(points, colours, WHITE, (21.6, 5.0, 66.4, 1.05))
        _dots(points, colours, (70, 40, 30), (28.5, 1.9, 58.4, 1.1))
        smile = np.abs(np.hypot(y, z - 61) - 8.2) < 0.65
        colours[smile & (z < 56) & (x > 20)] = (110, 40, 36)
        _dots(points, colours, tan, (34, 16.5, 6, 5.5))

    return Model(
        parts=(
            Part(ellipsoid((-2, 0, 22), (17, 17, 23)), brown),
            Part(ellipsoid((3, 0, 62), (18.5, 19, 17.5)), brown, 4),
            Part(ellipsoid((19, 0, 55.5), (10, 10.5, 7)), tan, 3),
            Part(mirror_y(ellipsoid((2, 23, 63), (3.2, 7, 7.5), (0, 0, 12))), brown, 2),
            Part(mirror_y(curve((0, 14, 38, 6), (8, 22, 30, 5.2), (17, 21, 21, 4.8))), brown, 3),
            Part(mirror_y(ellipsoid((19, 20, 20), (4.8, 4.4, 4.4))), tan, 2),
            Part(mirror_y(chain((-4, 12, 9, 10), (22, 18, 10, 7.5))), brown, 4),
            Part(mirror_y(ellipsoid((27, 18, 7.5), (5.8, 5.8, 9.5))), tan, 3),
            Part(
                curve((-15, 0, 8, 4), (-25, -6, 5, 3.6), (-27, -17, 8, 3.4), (-23, -22, 18, 3.2), (-20, -19, 25, 3)),
                brown,
                3,
            ),
        ),
        hulls=(
            ((-20, -16, 19), (17, 16, 38)),
            ((-16, -14, 37), (12, 14, 45)),
            ((-18, -9, -4), (15, 9, 20)),
            ((-20, -20, 45), (34, 20, 88)),
            *make_box_pair((-6, 18.5, 50), (12, 36, 78)),
            *make_box_pair((-10, 14, 30), (9, 32, 46)),
            *make_box_pair((5, 15, 17), (26, 32, 31)),
            *make_box_pair((-16, 8, -4), (12, 26, 20)),
            *make_box_pair((10, 8, -4), (24, 30, 17)),
            *make_box_pair((23, 8, -4), (40, 32, 19)),
            ((-36, -34, -4), (-15, 4, 14)),
            ((-36, -34, 14), (-16, -12, 32)),
        ),
        low=(-36, -36, -4),
        high=(40, 36, 88),
        decorate=decorate,
        floor=0.0,
        step=0.8,
        triangles=1750,
        texture_size=384,
    )


def _heart(y: float, z: float, half_width: float, half_height: float) -> np.ndarray:
    """Return the outline (n, 2) in mm of a face, centred at (y, z), with two lobes at the top."""
    t = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    bulge = 1 - 0.22 * np.exp(-(((t - np.pi / 2) / 0.4) ** 2))
    return np.column_stack([y + half_width * np.cos(t) * bulge, z + half_height * np.sin(t) * bulge])
