"""The table of builtin objects: what they are called, how large and heavy they are, how they are made."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from PIL import Image

from asset_tools.builtin import bottles, fruits, shapes
from asset_tools.builtin.labels import paint_carton, paint_mug, paint_soap, paint_tube, paint_wrapped
from asset_tools.builtin.mesh import Shape, Size
from asset_tools.builtin.products import LABELS
from asset_tools.builtin.skins import paint_banana, paint_fruit
from asset_tools.builtin.spec import ObjectSpec


def _product(
    id: str,
    category: str,
    size: Size,
    mass: float,
    shape: Callable[[Size], Shape],
    paint: Callable[..., Image.Image],
    roughness: float = 0.45,
) -> ObjectSpec:
    return ObjectSpec(id, category, size, mass, shape, partial(paint, label=LABELS[id]), roughness)


def _fruit(
    id: str, size: Size, mass: float, profile: Sequence[tuple[float, float]], roughness: float, skin: dict, **form
):
    shape = partial(fruits.fruit, profile=profile, **form)
    return ObjectSpec(id, "fruit", size, mass, shape, partial(paint_fruit, **skin), roughness)


def _ball(radius: float, flatness: float, dimple: float) -> list[tuple[float, float]]:
    """Profile of a flattened ball with a dimple at the top."""
    line = [(radius * np.sin(a), -radius * flatness * np.cos(a)) for a in np.linspace(0, np.pi, 9)]
    line[-1] = (0.0, line[-1][1] - dimple)
    return [(float(r), float(z)) for r, z in line]


# (radius, z) in millimetres, from the bottom's centre to the top's.
APPLE = [(0, 6), (12, 0.5), (26, 12), (34.5, 36), (28, 58), (12, 64), (0, 56)]
PEAR = [(0, 3), (12, 1), (30, 20), (32, 37), (22, 62), (15, 78), (8, 88), (0, 87)]
LEMON = [(0, 0), (5, 3), (11, 9), (23, 23), (26, 36), (22, 51), (10, 63), (5, 69), (0, 72)]


def _metres(profile: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    return [(r / 1000, z / 1000) for r, z in profile]


metal_wrapped = partial(paint_wrapped, metal=True)
tin = partial(shapes.can, exponent=5.0)
soft_carton = partial(shapes.carton, radius=0.007)
toothpaste_tube = partial(bottles.tube, cap_radius=0.014, cap_height=0.022)
cosmetics_tube = partial(bottles.tube, cap_radius=0.0115, cap_height=0.024)
face_wash_tube = partial(bottles.tube, cap_radius=0.0185, cap_height=0.026)

APPLE_SKIN = {
    "base": (206, 178, 70),
    "blush": (176, 22, 30),
    "blush_amount": 0.82,
    "streaks": 0.3,
    "poles": (176, 170, 74),
    "speckle": (226, 190, 130),
}
LEMON_SKIN = {"base": (246, 216, 46), "blush": (236, 198, 30), "pores": 0.03, "poles": (206, 200, 70)}
PEAR_SKIN = {
    "base": (176, 188, 66),
    "blush": (206, 150, 54),
    "blush_amount": 0.35,
    "speckle": (128, 110, 50),
    "poles": (140, 122, 56),
}
ORANGE_SKIN = {"base": (242, 138, 20), "blush": (232, 116, 12), "pores": 0.07, "poles": (186, 140, 50)}
PEACH_SKIN = {"base": (246, 190, 98), "blush": (208, 70, 58), "blush_amount": 0.55, "poles": (236, 190, 100)}

# Some are narrower than the real things: a gripper that opens 0.08 m can take each from above however it lies.
SPECS: tuple[ObjectSpec, ...] = (
    _product("sugar_box", "box", (0.068, 0.038, 0.150), 0.330, shapes.carton, paint_carton, 0.7),
    _product("tomato_soup_can", "can", (0.066, 0.066, 0.101), 0.349, shapes.can, metal_wrapped, 0.4),
    _product("mustard_bottle", "bottle", (0.070, 0.048, 0.175), 0.400, bottles.squeeze_bottle, paint_wrapped),
    _product("potted_meat_can", "can", (0.092, 0.046, 0.068), 0.250, tin, metal_wrapped, 0.4),
    ObjectSpec("banana", "fruit", (0.178, 0.074, 0.036), 0.118, fruits.banana, paint_banana, 0.6),
    _product("mug", "mug", (0.105, 0.075, 0.085), 0.280, shapes.mug, paint_mug, 0.25),
    _product("chips_can", "can", (0.070, 0.070, 0.235), 0.205, shapes.canister, paint_wrapped, 0.55),
    _fruit(
        "apple", (0.070, 0.069, 0.073), 0.160, _metres(APPLE), 0.35, APPLE_SKIN, lobes=0.03, stem=(0.05, 0.073, 0.0014)
    ),
    _fruit("lemon", (0.052, 0.051, 0.072), 0.095, _metres(LEMON), 0.45, LEMON_SKIN, lobes=0.015),
    _fruit(
        "pear",
        (0.066, 0.064, 0.100),
        0.175,
        _metres(PEAR),
        0.5,
        PEAR_SKIN,
        lobes=0.02,
        lean=0.06,
        cuts=(0.066,),
        stem=(0.08, 0.1, 0.0016),
    ),
    _fruit("orange", (0.069, 0.069, 0.065), 0.150, _ball(0.034, 0.95, 0.0025), 0.5, ORANGE_SKIN, lobes=0.008),
    _fruit("peach", (0.063, 0.062, 0.058), 0.130, _ball(0.031, 0.95, 0.005), 0.85, PEACH_SKIN, groove=0.08),
    _product("toothpaste_tube", "tube", (0.0565, 0.036, 0.165), 0.135, toothpaste_tube, paint_tube, 0.35),
    _product("cosmetics_tube", "tube", (0.0408, 0.026, 0.110), 0.060, cosmetics_tube, paint_tube),
    _product("face_wash_tube", "tube", (0.0628, 0.040, 0.160), 0.125, face_wash_tube, paint_tube),
    _product("soap_box", "box", (0.092, 0.060, 0.036), 0.115, soft_carton, paint_carton, 0.55),
    _product("soap_bar", "soap", (0.085, 0.055, 0.030), 0.100, shapes.soap_bar, paint_soap, 0.5),
    _product(
        "mouth_rinse_bottle", "bottle", (0.072, 0.048, 0.175), 0.330, bottles.screw_cap_bottle, paint_wrapped, 0.25
    ),
    _product("shampoo_bottle", "bottle", (0.072, 0.048, 0.200), 0.390, bottles.pump_bottle, paint_wrapped, 0.35),
    _product("lotion_bottle", "bottle", (0.064, 0.038, 0.170), 0.240, bottles.flip_top_bottle, paint_wrapped),
    _product("toothpaste_box", "box", (0.195, 0.045, 0.038), 0.150, shapes.carton, paint_carton, 0.6),
    _product("jam_jar", "jar", (0.066, 0.066, 0.085), 0.320, shapes.jar, paint_wrapped, 0.2),
    _product("drink_bottle", "bottle", (0.064, 0.064, 0.200), 0.480, bottles.drink_bottle, paint_wrapped, 0.25),
)
