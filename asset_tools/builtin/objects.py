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
from asset_tools.builtin.toys import TOYS


def _product(
    graspnet_id: int,
    id: str,
    category: str,
    size: Size,
    mass: float,
    shape: Callable[[Size], Shape],
    paint: Callable[..., Image.Image],
    roughness: float = 0.45,
    *,
    spoken: str = "",
    hollow: bool = False,
) -> ObjectSpec:
    print_on = partial(paint, label=LABELS[id])
    return ObjectSpec(id, category, size, mass, shape, print_on, roughness, graspnet_id, spoken, hollow)


def _fruit(
    graspnet_id: int,
    id: str,
    size: Size,
    mass: float,
    profile: Sequence[tuple[float, float]],
    roughness: float,
    skin: dict,
    **form,
) -> ObjectSpec:
    shape = partial(fruits.fruit, profile=profile, **form)
    return ObjectSpec(id, "fruit", size, mass, shape, partial(paint_fruit, **skin), roughness, graspnet_id)


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
cosmetics_tube = partial(bottles.tube, cap_radius=0.0135, cap_height=0.034)
toothpaste_tube = partial(bottles.tube, cap_radius=0.0105, cap_height=0.020)
oil_control_tube = partial(bottles.tube, cap_radius=0.0115, cap_height=0.022, flare=1.5)
face_wash_tube = partial(bottles.tube, cap_radius=0.0195, cap_height=0.026)
waisted_bottle = partial(bottles.flip_top_bottle, exponent=2.3, cap_height=0.13, taper=0.46, waist=0.16)
round_pump_bottle = partial(bottles.pump_bottle, exponent=2.0, body=0.58, reach=1.0)

APPLE_SKIN = {
    "base": (206, 178, 70),
    "blush": (176, 22, 30),
    "blush_amount": 0.82,
    "streaks": 0.3,
    "crown": (168, 168, 62),
    "speckle": (226, 190, 130),
}
LEMON_SKIN = {"base": (246, 216, 46), "blush": (236, 198, 30), "pores": 0.03, "poles": (190, 196, 70)}
PEAR_SKIN = {
    "base": (176, 188, 66),
    "blush": (206, 150, 54),
    "blush_amount": 0.35,
    "speckle": (128, 110, 50),
    "poles": (140, 122, 56),
}
ORANGE_SKIN = {"base": (242, 138, 20), "blush": (232, 116, 12), "pores": 0.09, "poles": (120, 136, 52)}
PEACH_SKIN = {
    "base": (248, 196, 104),
    "blush": (200, 56, 54),
    "blush_amount": 0.55,
    "poles": (236, 196, 100),
    "bloom": (252, 220, 190),
    "groove": 0.12,
}
PLUM_SKIN = {
    "base": (112, 30, 66),
    "blush": (46, 20, 58),
    "blush_amount": 0.72,
    "poles": (150, 106, 60),
    "bloom": (150, 146, 186),
    "groove": 0.3,
}

HOUSEHOLD: tuple[ObjectSpec, ...] = (
    _product(1, "sugar_box", "box", (0.089, 0.038, 0.175), 0.514, shapes.carton, paint_carton, 0.7),
    _product(2, "tomato_soup_can", "can", (0.066, 0.066, 0.101), 0.349, shapes.can, metal_wrapped, 0.4),
    _product(3, "mustard_bottle", "bottle", (0.095, 0.058, 0.190), 0.603, bottles.squeeze_bottle, paint_wrapped),
    _product(4, "potted_meat_can", "can", (0.097, 0.050, 0.082), 0.370, tin, metal_wrapped, 0.4),
    ObjectSpec("banana", "fruit", (0.178, 0.074, 0.036), 0.118, fruits.banana, paint_banana, 0.6, 5),
    _product(7, "mug", "mug", (0.117, 0.093, 0.081), 0.118, shapes.mug, paint_mug, 0.25, hollow=True),
    _product(10, "chips_can", "can", (0.075, 0.075, 0.250), 0.205, shapes.canister, paint_wrapped, 0.55),
    _fruit(
        12,
        "apple",
        (0.075, 0.074, 0.078),
        0.160,
        _metres(APPLE),
        0.35,
        APPLE_SKIN,
        lobes=0.03,
        stem=(0.05, 0.073, 0.0014),
    ),
    _fruit(13, "lemon", (0.054, 0.053, 0.068), 0.095, _metres(LEMON), 0.45, LEMON_SKIN, lobes=0.015),
    _fruit(14, "peach", (0.059, 0.058, 0.056), 0.130, _ball(0.031, 0.95, 0.005), 0.9, PEACH_SKIN, groove=0.08),
    _fruit(
        15,
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
    _fruit(16, "orange", (0.073, 0.073, 0.069), 0.160, _ball(0.034, 0.95, 0.0025), 0.5, ORANGE_SKIN, lobes=0.008),
    _fruit(17, "plum", (0.049, 0.048, 0.052), 0.065, _ball(0.024, 1.07, 0.002), 0.45, PLUM_SKIN, groove=0.05),
    _product(
        34, "secret_repair", "tube", (0.0503, 0.032, 0.125), 0.075, cosmetics_tube, paint_tube, spoken="cosmetics tube"
    ),
    _product(
        35,
        "cleansing_foam",
        "bottle",
        (0.055, 0.040, 0.150),
        0.130,
        bottles.foamer,
        paint_wrapped,
        spoken="cleansing foam bottle",
    ),
    _product(
        36,
        "washing_soap",
        "bottle",
        (0.070, 0.042, 0.190),
        0.300,
        waisted_bottle,
        paint_wrapped,
        spoken="body wash bottle",
    ),
    _product(
        37,
        "mouth_rinse",
        "bottle",
        (0.072, 0.048, 0.175),
        0.330,
        bottles.screw_cap_bottle,
        paint_wrapped,
        0.25,
        spoken="mouth rinse bottle",
    ),
    _product(
        38,
        "sod_lotion",
        "bottle",
        (0.055, 0.035, 0.150),
        0.200,
        bottles.disc_top_bottle,
        paint_wrapped,
        spoken="lotion bottle",
    ),
    _product(39, "soap_box", "box", (0.092, 0.060, 0.036), 0.115, soft_carton, paint_carton, 0.55),
    _product(
        40,
        "cleanser",
        "bottle",
        (0.055, 0.055, 0.175),
        0.230,
        round_pump_bottle,
        paint_wrapped,
        spoken="cleanser pump bottle",
    ),
    _product(
        41,
        "toothpaste",
        "tube",
        (0.0503, 0.032, 0.185),
        0.135,
        toothpaste_tube,
        paint_tube,
        0.35,
        spoken="toothpaste tube",
    ),
    _product(
        42,
        "face_oil_control",
        "tube",
        (0.055, 0.035, 0.150),
        0.120,
        oil_control_tube,
        paint_tube,
        0.35,
        spoken="dark blue face cream tube",
    ),
    _product(44, "jam_jar", "jar", (0.068, 0.068, 0.090), 0.360, shapes.jar, paint_wrapped, 0.2),
    _product(
        57,
        "drink",
        "bottle",
        (0.066, 0.066, 0.215),
        0.520,
        bottles.drink_bottle,
        paint_wrapped,
        0.25,
        spoken="drink bottle",
    ),
    _product(58, "toothpaste_box", "box", (0.195, 0.045, 0.038), 0.150, shapes.carton, paint_carton, 0.6),
    _product(59, "soap", "soap", (0.085, 0.055, 0.030), 0.100, shapes.soap_bar, paint_soap, spoken="bar of soap"),
    _product(
        61, "face_wash", "tube", (0.0628, 0.040, 0.165), 0.125, face_wash_tube, paint_tube, spoken="face wash tube"
    ),
    _product(
        62,
        "shampoo_white",
        "bottle",
        (0.078, 0.046, 0.205),
        0.400,
        bottles.teardrop_bottle,
        paint_wrapped,
        spoken="white shampoo bottle",
    ),
    _product(
        63,
        "shampoo_supreme",
        "bottle",
        (0.078, 0.044, 0.210),
        0.400,
        bottles.tapered_bottle,
        paint_wrapped,
        0.3,
        spoken="golden shampoo bottle",
    ),
    _product(
        64,
        "mouthwash",
        "bottle",
        (0.045, 0.045, 0.165),
        0.180,
        bottles.flask,
        paint_wrapped,
        0.2,
        spoken="mouthwash flask",
    ),
    _product(
        65,
        "shower_cream",
        "bottle",
        (0.078, 0.045, 0.200),
        0.300,
        bottles.upended_bottle,
        paint_wrapped,
        spoken="shower cream bottle",
    ),
    _product(
        66,
        "shampoo_care",
        "bottle",
        (0.072, 0.048, 0.200),
        0.390,
        bottles.pump_bottle,
        paint_wrapped,
        0.35,
        spoken="purple shampoo bottle",
    ),
)
SPECS: tuple[ObjectSpec, ...] = (*HOUSEHOLD, *TOYS)
