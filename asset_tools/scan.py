"""Guess units and up axes of raw scans from their sizes and shapes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, get_args

import numpy as np
import trimesh
from numpy.typing import NDArray
from shapely import MultiPoint

from robocas_ms3.core.errors import AssetError

Array = NDArray[np.float64]
Unit = Literal["m", "cm", "mm", "inch"]
Up = Literal["x", "y", "z", "-x", "-y", "-z"]

METRES_PER_UNIT: dict[str, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254}
UP_AXES: tuple[str, ...] = get_args(Up)
PLAUSIBLE = (0.005, 1.5)  # m, longest side of an object that a gripper may pick
TYPICAL = 0.15  # m, longest side of a household object
GIANT = 5.0  # times the typical size; a larger scan is more likely in a unit ten times smaller
FAR = np.log(20)  # log ratio to the typical size; limits the weight of a scan in the guess for a folder
MIN_UPRIGHT_RATIO = 0.27  # thickness over height; thinner boxes are not placed upright
BOX_FILL = 0.93  # outline over bounding rectangle of a box; 0.785 for an ellipse


def guess_common_unit(longest: Sequence[float]) -> Unit:
    """Guess one unit for all scans: metres, centimetres or millimetres.

    Inches are never guessed, since sizes in inches and in centimetres are too similar.

    Args:
        longest: longest side of each scan, in the unknown unit.

    Raises:
        AssetError: the size is implausible for picking in every unit.
    """
    middle = float(np.median(longest))
    best = min(("m", "cm", "mm"), key=lambda unit: abs(np.log(middle * METRES_PER_UNIT[unit] / TYPICAL)))
    if not PLAUSIBLE[0] <= middle * METRES_PER_UNIT[best] <= PLAUSIBLE[1]:
        raise AssetError(
            "cannot guess the unit of the scans",
            expected=f"a longest side of {PLAUSIBLE[0]} to {PLAUSIBLE[1]} m in metres, centimetres or millimetres",
            found=f"a longest side of {middle:g}",
            fix="Pass --units with the unit of the files.",
        )
    return best  # pyright: ignore[reportReturnType]


def guess_units(longest: Mapping[str, float]) -> dict[str, Unit]:
    """Guess the unit of each scan of a folder.

    Scans have the common unit of the folder. A scan that would be too large or too small in this unit gets another
    unit.

    Args:
        longest: name of the scan -> longest side, in the unknown unit.

    Raises:
        AssetError: the size of a scan is implausible for picking in every unit.
    """
    cost = {
        unit: sum(min(abs(np.log(side * METRES_PER_UNIT[unit] / TYPICAL)), FAR) for side in longest.values())
        for unit in ("m", "cm", "mm")
    }
    usual: Any = min(cost, key=lambda unit: cost[unit])
    units: dict[str, Unit] = {}
    for name, side in longest.items():
        fits = PLAUSIBLE[0] <= side * METRES_PER_UNIT[usual] <= GIANT * TYPICAL
        try:
            units[name] = usual if fits else guess_common_unit([side])
        except AssetError as error:
            raise AssetError(
                error.what, where=name, expected=error.expected, found=error.found, fix=error.fix
            ) from error
    return units


def guess_up_axis(mesh: trimesh.Trimesh) -> Up:
    """Guess the axis that points up: y or z, the two conventions of modelling software.

    If y or z is the longest axis, the object is assumed to stand along this axis, unless it is a thin box. Otherwise
    the object is assumed to lie on its broad side.

    Args:
        mesh: mesh in any unit.
    """
    hull = mesh.convex_hull
    x, y, z = np.ptp(hull.vertices, axis=0)
    size = {"x": x, "y": y, "z": z}
    long = max(size, key=lambda axis: size[axis])
    if long != "x":
        across = sorted(size[axis] for axis in size if axis != long)
        boxy = _fill(hull, "xyz".index(long)) > BOX_FILL
        if not boxy or across[0] / size[long] >= MIN_UPRIGHT_RATIO:
            return long  # pyright: ignore[reportReturnType]
    return "y" if y < z else "z"


def rotate_upright(mesh: trimesh.Trimesh, up: Up) -> trimesh.Trimesh:
    """Return a copy of a mesh, rotated so that the axis ``up`` becomes +z."""
    turned = mesh.copy(include_cache=True)  # keeps its normals
    axis = np.zeros(3)
    axis["xyz".index(up[-1])] = -1.0 if up.startswith("-") else 1.0
    transform = np.diag([1.0, -1.0, -1.0, 1.0]) if up == "-z" else np.eye(4)
    if axis[2] == 0:
        quarter = trimesh.transformations.rotation_matrix(np.pi / 2, np.cross(axis, [0.0, 0.0, 1.0]))
        transform = np.round(quarter)  # exact, so that boxes stay boxes
    turned.apply_transform(transform)
    return turned


def _fill(hull: trimesh.Trimesh, axis: int) -> float:
    """Return how much of a rectangle the outline of a convex body fills, 0 to 1, seen along an axis.

    Args:
        hull: convex mesh.
        axis: index of the axis of view.
    """
    flat = np.delete(hull.vertices, axis, axis=1)
    outline = MultiPoint(flat).convex_hull
    return float(outline.area / outline.minimum_rotated_rectangle.area)
