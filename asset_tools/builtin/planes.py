"""Make models of toy aeroplanes; lengths in mm, noses towards +x, wheels at z = 0."""

from __future__ import annotations

import numpy as np

from asset_tools.builtin.blends import (
    box,
    chain,
    curve,
    cylinder,
    ellipsoid,
    mirror_y,
    plate,
    polygon,
    revolve,
    union,
)
from asset_tools.builtin.models import Model, Part, make_box_pair
from asset_tools.builtin.textures import Colour

DARK: Colour = (34, 34, 38)
WHITE: Colour = (244, 244, 242)
STEEL: Colour = (150, 154, 160)


def _star(x: float, y: float, radius: float) -> list[tuple[float, float]]:
    angle = np.pi / 2 + np.pi * np.arange(10) / 5
    reach = radius * np.where(np.arange(10) % 2, 0.42, 1.0)
    return [(float(a), float(b)) for a, b in np.column_stack([x + reach * np.cos(angle), y + reach * np.sin(angle)])]


def make_red_airplane() -> Model:
    """Make a red wooden aeroplane with one propeller, straight wings with stars and a yellow nose."""
    red: Colour = (204, 34, 30)
    yellow: Colour = (248, 200, 40)
    star = polygon(_star(14, 50, 9.5))
    wing = [(31, 12), (31, 66), (26, 74), (0, 74), (-4, 66), (-4, 12), (-4, -12), (31, -12)]
    tail = [(-48, 0), (-50, 20), (-54, 26), (-68, 26), (-71, 20), (-71, 0)]
    fin = [(-44, 30), (-58, 56), (-70, 58), (-71, 30)]

    def decorate(points, normals, colours, rng):
        x, y, z = points.T
        spot = np.column_stack([x, np.abs(y)])
        on_wing = (np.abs(y) > 20) & (x < 32) & (x > -6)
        disc = on_wing & (np.hypot(spot[:, 0] - 14, spot[:, 1] - 50) < 12)
        colours[disc] = (36, 66, 150)
        colours[disc & (star(spot) < 0)] = WHITE
        colours[(np.abs(y) > 69) & on_wing] = yellow
        colours[(z > 49) & (x < -50)] = yellow
        grain = np.cos(0.9 * z + 0.5 * y + 1.6 * np.sin(0.05 * x))
        colours *= (1 + 0.025 * grain)[:, None]
        hub = (np.hypot(np.abs(y) - 18, z - 9) < 3.4) & (z < 20) & (np.abs(y) > 10)
        colours[hub & (np.hypot(x - 24, z - 9) < 3.6)] = yellow
        colours[(np.hypot(x - 24, z - 9) < 3.6) & (np.abs(y) > 15) & (z < 14)] = yellow

    return Model(
        parts=(
            Part(chain((-62, 0, 30, 6.5), (-10, 0, 28, 13.5), (36, 0, 27, 15.5)), red),
            Part(cylinder("x", (49, 0, 27), 16, 16, 3), yellow),
            Part(plate("x", 61, 5, _blade(27, 27, 25, 4.2), edge=2.2), (36, 66, 150)),
            Part(revolve("x", (0, 0, 27), [(55, 7.5), (62, 6.5), (68, 2.5)], 1), (36, 66, 150)),
            Part(mirror_y(plate("z", 26, 7.5, wing, edge=3)), red),
            Part(mirror_y(plate("z", 31, 6, tail, edge=2.6)), red),
            Part(plate("y", 0, 6, fin, edge=2.6), red),
            Part(ellipsoid((8, 0, 40), (13, 8.5, 9)), (120, 190, 226)),
            Part(mirror_y(cylinder("y", (24, 16, 9), 7, 9, 2)), DARK),
            Part(cylinder("y", (24, 0, 9), 30, 3), (190, 150, 96)),
            Part(union(mirror_y(box((24, 8.5, 14), (8, 5, 14), 1))), (190, 150, 96)),
            Part(chain((-61, 0, 28, 4), (-63, 0, 5, 3.4)), (190, 150, 96)),
            Part(cylinder("y", (-63, 0, 5), 7, 5, 1.2), DARK),
        ),
        hulls=(
            ((-72, -14, 18), (-44, 14, 37)),
            ((-44, -14, 13), (-4, 14, 44)),
            ((-4, -15.6, 11), (41, 15.6, 41.5)),
            ((41, -17, 10), (57.5, 17, 44)),
            ((-8, -12, 38), (24, 12, 54)),
            ((-8, -82, 22.2), (34, 82, 29.8)),
            ((-80, -32, 28), (-44, 32, 34)),
            ((-80, -5, 35), (-42, 5, 68)),
            ((58.4, -9, -4), (63.6, 9, 60)),
            ((57, -9, 18), (78, 9, 36)),
            *make_box_pair((10, 12, -4), (40, 30, 20)),
            ((18, -13, 4), (30, 13, 14)),
            ((-72, -8, -4), (-54, 8, 24)),
        ),
        low=(-80, -82, -4),
        high=(78, 82, 68),
        decorate=decorate,
        step=1.0,
        triangles=1600,
        texture_size=400,
    )


def _blade(y: float, z: float, length: float, half_width: float) -> list[tuple[float, float]]:
    """Return the outline (y, z) of a propeller with two vertical blades, centred at (y, z), mm."""
    side = [(0.55, 0.0), (1.0, 0.45), (1.0, 0.85), (0.4, 1.0)]
    half = [(w * half_width, t * length) for w, t in side]
    right = [*((w, -t) for w, t in reversed(half)), *half]
    return [(w, z + t) for w, t in right] + [(-w, z + t) for w, t in reversed(right)]


def make_airliner() -> Model:
    """Make a white airliner with a blue tail, swept wings, two jet engines and rows of windows."""
    blue: Colour = (28, 84, 170)
    pale: Colour = (214, 218, 224)
    wing = [(24, 0), (20, 8), (-22, 66), (-26, 70), (-33, 70), (-34, 66), (-16, 22), (-16, 0)]
    tail = [(-56, 0), (-58, 4), (-72, 25), (-79, 25), (-76, 0)]
    fin = [(-46, 30), (-52, 36), (-70, 64), (-80, 64), (-74, 30)]

    def decorate(points, normals, colours, rng):
        x, y, z = points.T
        side = (np.abs(normals[:, 1]) > 0.5) & (np.abs(y) > 5) & (np.abs(y) < 14)
        body = side & (z > 18) & (z < 42)
        window = (np.abs((x + 2) % 7 - 3.5) < 1.3) & (np.abs(z - 32) < 1.7) & (x > -50) & (x < 50)
        colours[body & (np.abs(z - 26.6) < 1.3) & (x < 66)] = blue
        colours[body & window] = DARK
        door = (np.abs(np.abs(x - 55.5) - 2.6) < 0.5) & (np.abs(z - 30) < 5)
        colours[body & door] = STEEL
        cockpit = (x > 62.5) & (x < 71) & (z > 31.5) & (z < 36) & (np.abs(y) < 12)
        colours[cockpit & (np.abs(np.abs(y) - 0.2) > 0.5)] = (26, 32, 44)
        engine = (np.hypot(np.abs(y) - 27, z - 13) < 6.5) & (normals[:, 0] > 0.6) & (x > 8)
        colours[engine & (np.hypot(np.abs(y) - 27, z - 13) < 4.6)] = DARK
        lip = (np.hypot(np.abs(y) - 27, z - 13) < 8) & (x > 14.5)
        colours[lip & ~engine] = STEEL
        tip = (np.abs(y) > 63) & (x < -10)
        colours[tip] = blue
        flap = (
            (np.abs(x + 11.5 + 0.36 * (np.abs(y) - 18)) < 0.45)
            & (np.abs(y) > 16)
            & (np.abs(y) < 58)
            & (normals[:, 2] > 0.7)
        )
        colours[flap & (z < 27)] = (150, 156, 164)
        stripe = (x < -58) & (z > 42) & (np.abs(z + 0.5 * x - 18) < 2.6)
        colours[stripe] = WHITE

    return Model(
        parts=(
            Part(
                revolve(
                    "x",
                    (0, 0, 30),
                    [(-82, 2.2), (-66, 6.4), (-46, 10.4), (-34, 11), (54, 11), (66, 9), (74, 5.2), (78, 1.5)],
                    1.2,
                ),
                WHITE,
            ),
            Part(mirror_y(plate("z", 23.5, 5.0, wing, edge=2.0)), pale, 2),
            Part(mirror_y(plate("z", 34, 4.4, tail, edge=1.8)), pale, 2),
            Part(plate("y", 0, 4.4, fin, edge=1.8), blue, 2),
            Part(mirror_y(revolve("x", (0, 27, 13), [(-10, 4.4), (-2, 6), (10, 6.6), (17, 5.8)], 0.8)), blue),
            Part(mirror_y(box((0, 27, 20), (18, 2.6, 6), 1)), pale),
            Part(mirror_y(cylinder("y", (-8, 9, 5), 5, 5, 1.2)), DARK),
            Part(mirror_y(chain((-8, 9, 5, 2.2), (-8, 9, 24, 2.2))), STEEL),
            Part(cylinder("y", (56, 0, 5), 6, 5, 1.2), DARK),
            Part(chain((56, 0, 5, 2.2), (56, 0, 22, 2.2)), STEEL),
        ),
        hulls=(
            ((-40, -12, 18), (90, 12, 42)),
            ((-92, -12, 18), (-40, 12, 41)),
            ((-92, -5, 40), (-44, 5, 74)),
            *make_box_pair((-92, 3, 31.6), (-50, 30, 36.4)),
            *make_box_pair((-42, 10, 20.9), (28, 22, 26.1)),
            *make_box_pair((-42, 22, 20.9), (28, 78, 26.1)),
            *make_box_pair((-14, 18, 4), (22, 37, 20.8)),
            *make_box_pair((-16, 4, -4), (0, 15, 10.5)),
            ((48, -6, -4), (64, 6, 10.5)),
            *make_box_pair((-12, 6, 10), (-4, 12, 24)),
            ((53, -3, 10), (59, 3, 22)),
        ),
        low=(-92, -78, -4),
        high=(90, 78, 74),
        decorate=decorate,
        step=0.9,
        triangles=1750,
        texture_size=400,
        grain=0.0,
    )


def make_biplane() -> Model:
    """Make a yellow biplane with struts between the wings, an open cockpit and a round engine."""
    yellow: Colour = (250, 204, 32)
    green: Colour = (20, 104, 70)
    upper = [(26, 0), (26, 50), (20, 59), (2, 59), (-2, 52), (-2, 0)]
    lower = [(20, 0), (20, 46), (15, 53), (-2, 53), (-6, 46), (-6, 0)]
    tail = [(-36, 0), (-39, 15), (-44, 21), (-53, 21), (-56, 15), (-56, 0)]
    fin = [(-34, 32), (-42, 50), (-49, 54), (-56, 50), (-57, 32)]

    def decorate(points, normals, colours, rng):
        x, y, z = points.T
        across = np.abs(y)
        wings = (x < 28) & (x > -8) & (across > 13)
        colours[wings & (across > 40) & (across < 47)] = green
        colours[(x < -50) & (z > 33)] = green
        colours[(x < -38) & (across > 14) & (x < -49)] = green
        stripe = (np.abs(z - 31) < 2.0) & (np.abs(normals[:, 1]) > 0.5) & (x < 32) & (across < 13) & (across > 3)
        colours[stripe] = green
        face = (normals[:, 0] > 0.5) & (x > 38) & (x < 52)
        angle = np.arctan2(z - 31, y)
        ring = np.hypot(y, z - 31)
        colours[face & (ring < 12.2)] = (64, 66, 72)
        colours[face & (ring > 4.5) & (ring < 11.6) & (np.cos(7 * angle) > 0.1)] = (176, 178, 184)
        cockpit = ((x + 10) / 8.5) ** 2 + (y / 6.2) ** 2 < 1
        colours[cockpit & (z > 36) & (z < 46)] = DARK
        seam = np.abs(((x + 10) / 10) ** 2 + (y / 7.6) ** 2 - 1) < 0.22
        colours[seam & (z > 36) & (z < 46)] = (150, 88, 40)
        hub = (np.hypot(x - 22, z - 9) < 3.4) & (z < 16) & (across > 15)
        colours[hub] = yellow

    return Model(
        parts=(
            Part(curve((-52, 0, 33, 5.5), (-30, 0, 32, 8.5), (-4, 0, 31, 11.5), (30, 0, 31, 12.5)), yellow),
            Part(cylinder("x", (36, 0, 31), 15, 13.5, 2.5), green),
            Part(plate("x", 48.5, 4.0, _blade(0, 31, 25, 4.0), edge=1.8), (120, 72, 36)),
            Part(chain((42, 0, 31, 4), (50, 0, 31, 3.2)), STEEL),
            Part(mirror_y(plate("z", 60, 5.2, upper, edge=2.2)), yellow),
            Part(mirror_y(plate("z", 26, 5.2, lower, edge=2.2)), yellow),
            Part(mirror_y(chain((16, 36, 26, 2.2), (20, 36, 60, 2.2))), (150, 104, 60)),
            Part(mirror_y(chain((0, 36, 26, 2.2), (4, 36, 60, 2.2))), (150, 104, 60)),
            Part(mirror_y(chain((18, 7, 38, 2.2), (20, 10, 60, 2.2))), (150, 104, 60)),
            Part(mirror_y(chain((2, 7, 38, 2.2), (4, 10, 60, 2.2))), (150, 104, 60)),
            Part(mirror_y(plate("z", 34, 4.6, tail, edge=2)), yellow),
            Part(plate("y", 0, 4.6, fin, edge=2), yellow),
            Part(mirror_y(cylinder("y", (22, 18, 9), 6, 9, 2)), DARK),
            Part(mirror_y(chain((20, 7, 24, 2.6), (22, 16, 9, 2.6))), STEEL),
            Part(cylinder("y", (22, 0, 9), 34, 2.2), STEEL),
            Part(chain((-50, 0, 32, 3), (-51, 0, 5, 2.6)), STEEL),
            Part(cylinder("y", (-51, 0, 4.5), 6, 4.5, 1.2), DARK),
        ),
        hulls=(
            ((-24, -13, 18), (28, 13, 43.6)),
            ((28, -16, 15), (46, 16, 47)),
            ((-60, -12, 26), (-24, 12, 41)),
            ((-8, -66, 57.3), (30, 66, 66)),
            ((-10, -60, 23), (24, 60, 28.7)),
            ((-60, -26, 31.6), (-32, 26, 36.4)),
            ((-60, -5, 37), (-30, 5, 58)),
            ((46, -10, 0), (51, 10, 64)),
            *make_box_pair((8, 14.5, -4), (36, 26, 22)),
            ((18, -15, 6), (26, 15, 12)),
            *make_box_pair((15, 5, 11), (27, 16, 20)),
            ((-58, -6, -4), (-44, 6, 27)),
            *make_box_pair((-4, 32, 29.5), (10, 40, 56.7)),
            *make_box_pair((11, 32, 29.5), (26, 40, 56.7)),
            *make_box_pair((-2, 5, 43), (9, 14, 56.7)),
            *make_box_pair((12, 5, 43), (26, 14, 56.7)),
        ),
        low=(-66, -66, -4),
        high=(60, 66, 70),
        decorate=decorate,
        step=0.85,
        triangles=1600,
        texture_size=304,
        grain=0.0,
    )
