"""Make models of tools, a padlock and a computer mouse; lengths in mm."""

from __future__ import annotations

import numpy as np

from asset_tools.builtin.blends import (
    box,
    chain,
    curve,
    cylinder,
    ellipsoid,
    hoop,
    intersect,
    mirror_y,
    plate,
    revolve,
    subtract,
    transform,
)
from asset_tools.builtin.models import Model, Part, make_box_pair
from asset_tools.builtin.textures import Colour, compute_text_mask

BLACK: Colour = (30, 30, 32)
STEEL: Colour = (176, 180, 186)
SILVER: Colour = (206, 208, 212)


def make_power_drill() -> Model:
    """Make a cordless power drill with an orange housing and a black chuck and grip.

    It stands on the battery.
    """
    orange: Colour = (236, 98, 22)

    def decorate(points, normals, colours, rng):
        x, y, z = points.T
        side = np.abs(normals[:, 1]) > 0.6
        slots = side & (np.abs((x + 74) % 6 - 3) < 1.3) & (x > -74) & (x < -50) & (np.abs(z - 160) < 13)
        colours[slots] = BLACK
        ridges = np.abs((np.rad2deg(np.arctan2(z - 160, y)) + 360) % 20 - 10) < 3.6
        colours[ridges & (x > 62) & (x < 84)] = (84, 84, 88)
        colours[(x > 53) & (x < 60) & (z > 130)] = (150, 152, 156)  # clutch ring
        colours[(np.abs(x - 45) < 0.8) & (z > 128)] = BLACK
        label = side & (x > -40) & (x < 34) & (np.abs(z - 162) < 10)
        colours[label & (x > -38) & (x < 26)] = (40, 40, 44)
        flip = np.where(y > 0, -1, 1)  # letters run to the right as seen from outside
        colours[label & compute_text_mask("18V DRILL", (x + 6) * flip, z - 162, 9)] = (250, 250, 248)
        grip = (z > 62) & (z < 122) & (x < -28)
        colours[grip & ((z + 0.4 * x) % 6 < 1.8)] = (64, 64, 68)
        colours[side & (np.abs(z - 27) < 1.0) & (x < 50)] = (84, 84, 88)
        battery = side & compute_text_mask("LITHIUM", (x + 24) * flip, z - 14, 8)
        colours[battery & (z < 26)] = orange

    return Model(
        parts=(
            Part(revolve("x", (0, 0, 159), [(-82, 20), (-78, 24), (-60, 25.5), (30, 25.5), (46, 23)], 3), orange),
            Part(revolve("x", (0, 0, 159), [(46, 22), (60, 19), (62, 17), (82, 17), (90, 11)], 1.5), BLACK),
            Part(revolve("x", (0, 0, 159), [(88, 6), (98, 3.0)], 0.5), STEEL),
            Part(revolve("x", (0, 0, 159), [(-88, 17), (-76, 23)], 2.5), BLACK),
            Part(curve((-34, 0, 142, 19), (-40, 0, 118, 17), (-45, 0, 84, 16.5), (-46, 0, 44, 18)), BLACK, 8),
            Part(ellipsoid((-10, 0, 136), (20, 14, 14)), orange, 6),
            Part(box((-16, 0, 117), (16, 14, 24), 5, (0, -10, 0)), (196, 30, 24)),
            Part(box((-30, 0, 36), (100, 50, 20), 8), orange, 8),
            Part(box((-30, 0, 13), (110, 56, 28), 6), BLACK),
        ),
        hulls=(
            ((-96, -36, 132), (47, 36, 196)),
            ((47, -36, 126), (84, 36, 190)),
            ((84, -20, 140), (106, 20, 180)),
            ((-70, -30, 103), (26, 30, 134)),
            ((-76, -30, 49), (-10, 30, 104)),
            ((-96, -36, 26), (36, 36, 50)),
            ((-96, -36, -6), (36, 36, 26.5)),
        ),
        low=(-96, -36, -6),
        high=(106, 36, 196),
        decorate=decorate,
        floor=0.0,
        step=1.3,
        triangles=1700,
        texture_size=448,
    )


def make_scissors() -> Model:
    """Make slightly open scissors with steel blades and red handles with rings of different length."""
    red: Colour = (206, 36, 34)
    opening = 5.5
    blade = [(-32, -4.0), (-20, -7.5), (10, -8), (60, -4.2), (93, 1.0), (93, 1.8), (60, 2.2), (10, 4), (-32, 6)]

    def half(level: float, flip: float, ring: tuple[float, float], radii: tuple[float, float]):
        turn = (0, 0, -flip * opening)
        knife = plate("z", level, 3.2, [(x, flip * y) for x, y in blade], edge=0.6)
        arm = curve((-12, 0, 0, 4.2), (-26, flip * 1.5, 0, 5.5), (ring[0] + radii[0], flip * (ring[1] - 6), 0, 5.5))
        return tuple(
            transform(field, (0, 0, 0), turn)
            for field in (knife, hoop((ring[0], flip * ring[1]), radii, 4.6, 7.8), arm)
        )

    first = half(1.5, 1.0, (-68, 18), (25, 15))
    second = half(-1.5, -1.0, (-66, 17), (22, 14))

    def decorate(points, normals, colours, rng):
        x, y, z = points.T
        metal = x > -8
        edge = np.abs(normals[:, 2]) < 0.7
        colours[metal & edge] = (222, 224, 228)
        screw = (np.hypot(x, y) < 5.2) & (np.abs(normals[:, 2]) > 0.5)
        colours[screw] = (120, 122, 128)
        colours[screw & (np.abs(y - 0.5 * x) < 0.9)] = (44, 44, 48)

    return Model(
        parts=(
            Part(first[0], STEEL),
            Part(second[0], STEEL),
            Part(first[1], red),
            Part(second[1], red),
            Part(first[2], red, 3),
            Part(second[2], red, 3),
            Part(cylinder("z", (0, 0, 0), 9.5, 5, 1.2), SILVER),
        ),
        hulls=(
            *make_box_pair((-112, 0, -12), (-86, 50, 12)),
            *make_box_pair((-86, 25, -12), (-68, 56, 12)),
            *make_box_pair((-86, 0, -12), (-68, 25, 12)),
            *make_box_pair((-68, 25, -12), (-50, 56, 12)),
            *make_box_pair((-68, 0, -12), (-50, 25, 12)),
            *make_box_pair((-50, 0, -12), (-38, 56, 12)),
            ((-38, -56, -12), (-10, 56, 12)),
            ((-10, -20, -12), (30, 20, 12)),
            *make_box_pair((30, 0, -12), (102, 20, 12)),
        ),
        low=(-112, -56, -12),
        high=(102, 56, 12),
        decorate=decorate,
        step=0.7,
        triangles=1800,
        texture_size=384,
    )


def make_screwdriver() -> Model:
    """Make a screwdriver with a flat blade and a grooved yellow handle with black bands."""
    yellow: Colour = (246, 196, 24)
    handle = revolve(
        "x", (0, 0, 0), [(-106, 8), (-102, 13), (-84, 15), (-40, 13.2), (-24, 10.4), (-12, 12.4), (-4, 11), (0, 6)], 0.8
    )
    flutes = [
        cylinder("x", (-62, 19.2 * float(np.cos(a)), 19.2 * float(np.sin(a))), 74, 5.6, 5.5)
        for a in np.arange(6) * np.pi / 3
    ]
    blade = intersect(
        revolve("x", (0, 0, 0), [(0, 3.3), (86, 3.3), (92, 5.2), (108, 4.6)]),
        plate("y", 0, 14, [(0, 4), (80, 4), (108, 0.9), (108, -0.9), (80, -4), (0, -4)]),
    )

    def decorate(points, normals, colours, rng):
        x, y, z = points.T
        radius = np.hypot(y, z)
        angle = np.arctan2(z, y)
        along = np.clip(np.minimum(x + 99, -25 - x) / 6, 0, 1)  # the flutes end in round tips
        colours[(np.cos(6 * angle) > 1.6 - along**0.5) & (along > 0)] = BLACK
        colours[x < -100] = (206, 30, 26)
        colours[(x > -22) & (x < -5) & (np.abs(radius - 12) < 3)] = BLACK
        colours[(x > 97)] *= 0.72

    return Model(
        parts=(Part(subtract(handle, *flutes), yellow), Part(blade, SILVER)),
        hulls=(
            ((-114, -22, -22), (-30, 22, 22)),
            ((-30, -22, -22), (2, 22, 22)),
            ((2, -22, -22), (86, 22, 22)),
            ((86, -22, -22), (114, 22, 22)),
        ),
        low=(-114, -22, -22),
        high=(114, 22, 22),
        decorate=decorate,
        step=0.7,
        triangles=1700,
        texture_size=384,
        grain=0.0,
    )


def make_padlock() -> Model:
    """Make a padlock with a brass body and a steel shackle."""
    brass: Colour = (206, 160, 68)

    def decorate(points, normals, colours, rng):
        x, y, z = points.T
        body = z < 45.8
        colours[body] *= (1 + 0.05 * np.cos(3.1 * z + 0.6 * np.sin(0.4 * x)))[body, None]  # brushed
        front = body & (np.abs(normals[:, 1]) > 0.8)
        frame = np.maximum(np.abs(x) / 19.5, np.abs(z - 23) / 18.5)
        colours[front & (np.abs(frame - 1) < 0.035)] = (126, 92, 30)
        flip = np.where(y > 0, -1, 1)
        colours[front & compute_text_mask("40", x * flip, z - 28, 12)] = (110, 78, 24)
        colours[front & compute_text_mask("HARDENED", x * flip, z - 14, 4)] = (110, 78, 24)
        below = body & (normals[:, 2] < -0.8)
        slot = (np.hypot(x, y) < 5) & below
        colours[slot] = (150, 112, 44)
        colours[slot & (np.abs(y) < 1.0) & (np.abs(x) < 3.6)] = (26, 20, 14)
        top = (z > 44) & (z < 47) & (np.abs(np.hypot(np.abs(x) - 14, y) - 5.6) < 1.2)
        colours[top] = (92, 68, 26)

    return Model(
        parts=(
            Part(box((0, 0, 23), (47, 27, 46), 3.5), brass),
            Part(mirror_x(chain((14, 0, 36, 4.2), (14, 0, 57, 4.2))), STEEL),
            Part(_arch(14, 57, 4.2), STEEL),
        ),
        hulls=(
            ((-30, -20, -6), (30, 20, 46)),
            ((-22, -8, 46), (-8, 8, 60)),
            ((8, -8, 46), (22, 8, 60)),
            ((-22, -8, 60), (-7, 8, 82)),
            ((-7, -8, 60), (0, 8, 82)),
            ((0, -8, 60), (7, 8, 82)),
            ((7, -8, 60), (22, 8, 82)),
        ),
        low=(-30, -20, -6),
        high=(30, 20, 82),
        decorate=decorate,
        step=0.7,
        triangles=1500,
        texture_size=384,
        grain=0.0,
    )


def mirror_x(field):
    """Return the field of the part at x > 0 and its mirror image."""
    turned_field = mirror_y(lambda points: field(points[:, [1, 0, 2]]))
    return lambda points: turned_field(points[:, [1, 0, 2]])


def _arch(radius: float, z: float, tube: float):
    """Return the field of the upper half of a ring in the plane y = 0.

    Args:
        radius: radius of the ring, mm.
        z: height of the ring's centre, mm.
        tube: radius of the section, mm.
    """

    def field(points: np.ndarray) -> np.ndarray:
        ring = np.hypot(np.hypot(points[:, 0], points[:, 2] - z) - radius, points[:, 1]) - tube
        return np.maximum(ring, z - points[:, 2])

    return field


def make_computer_mouse() -> Model:
    """Make a white computer mouse with two buttons and a wheel; the front is towards +x."""
    white: Colour = (240, 240, 238)
    angle = np.linspace(0, 2 * np.pi, 36, endpoint=False)
    # Between an ellipse and a rectangle, narrower in front.
    across = 30 * np.sign(np.sin(angle)) * np.abs(np.sin(angle)) ** 0.8 * (1 - 0.05 * np.cos(angle))
    along = 52.5 * np.sign(np.cos(angle)) * np.abs(np.cos(angle)) ** 0.8
    outline = [(float(u), float(v)) for u, v in np.column_stack([along, across])]
    shell = intersect(plate("z", 15, 44, outline, edge=6), ellipsoid((-8, 0, -6), (66, 42, 43)), reach=8)

    def decorate(points, normals, colours, rng):
        x, y, z = points.T
        upper = z > 5.5
        grey = (120, 122, 126)
        colours[~upper] = (178, 180, 184)
        colours[upper & (np.abs(y) < 0.7) & (x > 4)] = grey
        colours[upper & (np.abs(x - 4 - 0.004 * y**2) < 0.7) & (normals[:, 2] > 0.35)] = grey
        slot = (np.abs(y) < 4.6) & (np.abs(x - 27) < 12.5)
        colours[slot & upper & (np.abs(y) > 3.1)] = (70, 72, 76)
        wheel = np.abs(y) < 3.2
        tread = wheel & (np.abs(x - 27) < 10.5) & upper
        colours[tread] = (56, 58, 62)
        angle = np.arctan2(z - 23, x - 27)
        colours[tread & (np.cos(26 * angle) > 0.5)] = (112, 114, 120)
        side = upper & (y > 18) & (np.abs(z - 17 - 0.04 * x) < 2.6) & (x > -22) & (x < 16) & (np.abs(x + 3) > 0.8)
        colours[side] = (150, 152, 158)
        below = normals[:, 2] < -0.8
        colours[below] = (60, 62, 66)
        colours[below & (np.abs(np.abs(x) - 40) < 4) & (np.abs(y) < 13)] = (210, 212, 214)
        colours[below & (np.hypot(x, y) < 5)] = (170, 20, 24)

    return Model(
        parts=(Part(shell, white), Part(cylinder("y", (27, 0, 23.5), 6.0, 9.6, 1.5), BLACK)),
        hulls=(((-62, -38, -5), (62, 38, 46)),),
        low=(-62, -38, -5),
        high=(62, 38, 46),
        decorate=decorate,
        floor=0.0,
        step=0.9,
        triangles=1400,
        texture_size=448,
        grain=0.0,
    )
